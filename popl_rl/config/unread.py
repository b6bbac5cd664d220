"""Which settings somebody gave that the chosen method does not read."""

from collections.abc import Mapping, Sequence

from popl_rl.config.method import SECTIONS, MethodConfig

__all__ = ["unread"]


def unread(
    overrides: Sequence[str], method: MethodConfig, readers: Mapping[str, Sequence[str]]
) -> list[str]:
    """Name overrides of sections that the chosen method is not built from.

    Settings that an environment's YAML makes for other methods are no mistake; what is typed is.

    Args:
        overrides: As given on the command line, such as ``"method.em.groups=3"``.
        method: The chosen method.
        readers: Sections that each known method reads, by its name.

    Returns:
        A problem for each, with the names of the methods that read the setting.
    """
    problems = []
    for override in overrides:
        key = override.lstrip("+~").split("=", 1)[0]
        parts = key.split(".")
        if len(parts) < 3 or parts[0] != "method" or parts[1] not in SECTIONS:
            continue
        section = parts[1]
        if section == "clone":
            if method.evolve != "code":
                problems.append(f"{key} is read with method.evolve=code alone, got {method.evolve}")
        elif section not in method.sections():
            others = ", ".join(name for name, reads in readers.items() if section in reads)
            problems.append(
                f"{key} is not read by method {method.name!r}, which reads "
                f"{', '.join(method.sections())}; it is read by {others or 'no known method'}"
            )
    return problems
