"""Checks that need nothing but the settings: every problem at once, each with a cure."""

from collections.abc import Sequence

__all__ = ["MOST", "MOST_SEED", "Checker", "check_workers", "parse_epsilon"]

#: No count of anything is greater: beyond it is a slip of the finger, or no machine's memory.
MOST = 10**8
#: Greatest seed: whatever is added to it still fits into 64 bits.
MOST_SEED = 10**18


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

    def at_least_one(self, section: object, *names: str, most: float = MOST) -> None:
        """Report settings that are below 1, or above ``most``."""
        for name in names:
            value = getattr(section, name)
            self.expect(value >= 1, name, "at least 1", value)
            self._at_most(name, value, most)

    def not_negative(self, section: object, *names: str, most: float = MOST) -> None:
        """Report settings that are negative, NaN, or above ``most``."""
        for name in names:
            value = getattr(section, name)
            self.expect(value >= 0, name, "at least 0", value)
            self._at_most(name, value, most)

    def positive(self, section: object, *names: str, most: float = MOST) -> None:
        """Report settings that are not positive, or above ``most``."""
        for name in names:
            value = getattr(section, name)
            self.expect(value > 0, name, "positive", value)
            self._at_most(name, value, most)

    def seed(self, section: object, name: str = "seed") -> None:
        """Report a seed that is negative, or that random generators cannot take; None is none."""
        value = getattr(section, name)
        fits = value is None or 0 <= value <= MOST_SEED
        self.expect(fits, name, f"in 0..{MOST_SEED}", value)

    def each(self, section: object, name: str, least: int, most: int = MOST) -> None:
        """Report a list with numbers outside ``least..most``."""
        values = list(getattr(section, name))
        self.expect(all(v >= least for v in values), name, f"numbers of at least {least}", values)
        self.expect(all(v <= most for v in values), name, f"numbers of at most {most}", values)

    def _at_most(self, name: str, value: float, most: float) -> None:
        # NaN is reported as being below already.
        self.expect(not value > most, name, f"at most {most:g}", value)

    def share(self, section: object, *names: str) -> None:
        """Report settings outside (0, 1]."""
        for name in names:
            value = getattr(section, name)
            self.expect(0 < value <= 1, name, "in (0, 1]", value)

    def one_of(self, section: object, name: str, known: Sequence[str]) -> None:
        """Report a setting that is none of the known words."""
        value = getattr(section, name)
        self.expect(value in known, name, ", ".join(known), value)


def check_workers(value: str | int, at: Checker) -> None:
    """Report a number of worker processes that is neither auto nor a count."""
    value = str(value)
    proper = value == "auto" or (value.isdecimal() and 1 <= int(value) <= 1024)
    at.expect(proper, "workers", "auto, or a number from 1 to 1024", value)


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
    if not 0 <= value < float("inf"):
        raise ValueError(
            f"method.popl.epsilon must be mad, a number of at least 0, or null, got {epsilon!r}"
        )
    return value
