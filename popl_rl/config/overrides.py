"""What somebody typed: settings that change nothing, or may not be changed."""

from collections.abc import Mapping, Sequence

from popl_rl.config.method import SECTIONS, MethodConfig

__all__ = ["CHANGEABLE", "OPEN", "changed", "changing_nothing", "fixed", "unread"]

#: Sections whose keys are arguments of a factory or a reader, which no schema lists.
OPEN = ("env.options", "env.data_options", "env.mixture", "method.options", "data.reader_options")
#: What may be given beside ``resume=``: nothing of it changes a result.
CHANGEABLE = ("threads", "workers", "checkpoint_interval", "logger", "evaluation.animate")


def changing_nothing(overrides: Sequence[str]) -> list[str]:
    """Name overrides with an empty mapping, which is merged with what is there, and deletions.

    Args:
        overrides: As given on the command line, such as ``"env.mixture={}"``.
    """
    problems = []
    for override in overrides:
        key, _, value = override.lstrip("+").partition("=")
        if key.startswith("~"):
            if not key[1:].startswith(tuple(f"{name}." for name in OPEN)):
                cure = f"give another value, as in {key[1:]}=..."
                problems.append(f"{key} deletes nothing, because every setting has a value: {cure}")
            continue
        if value.replace(" ", "") == "{}":
            cure = f"delete single entries, as in ~{key.lstrip('~')}.name"
            cure = "give null for equal shares" if key == "env.mixture" else cure
            problems.append(f"{key}={{}} changes nothing, because mappings are merged: {cure}")
    return problems


def fixed(overrides: Sequence[str]) -> list[str]:
    """Name the settings that may not be given beside ``resume=``.

    Args:
        overrides: As given on the command line, such as ``"seed=3"``.
    """
    keys = [override.lstrip("+~").partition("=")[0] for override in overrides]
    allowed = tuple(f"{name}." for name in ("resume", *CHANGEABLE))
    return [key for key in keys if not f"{key}.".startswith(allowed)]


def changed(overrides: Sequence[str]) -> list[str]:
    """Name the settings of a run that is resumed that somebody has changed, out of ``CHANGEABLE``.

    Args:
        overrides: As given on the command line, such as ``"threads=2"``.
    """
    keys = [f"{override.partition('=')[0]}." for override in overrides]
    return [name for name in CHANGEABLE if any(key.startswith(f"{name}.") for key in keys)]


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
