"""Checks that need nothing but the settings: every problem at once, each with a cure."""

from collections.abc import Sequence

__all__ = ["Checker", "parse_epsilon"]


class Checker:
    """Collects what is wrong with the settings of one section.

    Args:
        path: Where the section is, such as ``"method.popl"``.
        problems: List that problems are added to.
    """

    def __init__(self, path: str, problems: list[str]) -> None:
        self.path = path
        self.problems = problems

    def below(self, name: str) -> "Checker":
        """The checker of a section of this section."""
        return Checker(f"{self.path}.{name}" if self.path else name, self.problems)

    def expect(self, condition: bool, name: str, expected: str, value: object) -> None:
        """Report ``name must be expected, got value`` unless the condition holds."""
        if not condition:
            full = f"{self.path}.{name}" if self.path else name
            self.problems.append(f"{full} must be {expected}, got {value!r}")

    def at_least_one(self, section: object, *names: str) -> None:
        """Report settings that are below 1."""
        for name in names:
            value = getattr(section, name)
            self.expect(value >= 1, name, "at least 1", value)

    def not_negative(self, section: object, *names: str) -> None:
        """Report settings that are negative or NaN."""
        for name in names:
            value = getattr(section, name)
            self.expect(value >= 0, name, "at least 0", value)

    def positive(self, section: object, *names: str) -> None:
        """Report settings that are not positive."""
        for name in names:
            value = getattr(section, name)
            self.expect(value > 0, name, "positive", value)

    def share(self, section: object, *names: str) -> None:
        """Report settings outside (0, 1]."""
        for name in names:
            value = getattr(section, name)
            self.expect(0 < value <= 1, name, "in (0, 1]", value)

    def one_of(self, section: object, name: str, known: Sequence[str]) -> None:
        """Report a setting that is none of the known words."""
        value = getattr(section, name)
        self.expect(value in known, name, ", ".join(known), value)


def parse_epsilon(epsilon: str | float | None) -> float | str | None:
    """Read ``method.popl.epsilon``: ``"mad"``, a non-negative number, or None.

    Raises:
        ValueError: If it is something else.
    """
    if epsilon is None or epsilon == "mad":
        return epsilon
    try:
        value = float(epsilon)
    except ValueError:
        value = -1.0
    if not value >= 0:
        raise ValueError(
            f"method.popl.epsilon must be mad, a number of at least 0, or null, got {epsilon!r}"
        )
    return value
