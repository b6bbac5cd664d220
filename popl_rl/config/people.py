"""Settings of judging by people whose groups nobody knows."""

from dataclasses import dataclass, field

from popl_rl.config.checks import Checker

__all__ = ["PeopleConfig"]


@dataclass
class PeopleConfig:
    """How a result is judged where the answers are real people's: held-out raters."""

    folds: int = 5  # parts of the people: each is held out once by popl-people, the first by
    # popl-train
    least: int = 10  # strict answers that a person needs to be held out
    # Answers of a new person that are told to whoever predicts the person's other answers.
    curve: list[int] = field(default_factory=lambda: [0, 1, 2, 5, 10, 20])
    repeats: int = 1  # random divisions of each person's answers into told and judged
    validation: float = 0.15  # share of the other people that scales and numbers are chosen by
    # Methods that popl-people compares, besides pooled CPL and one model for each person.
    methods: list[str] = field(default_factory=lambda: ["popl", "em", "vpl"])
    individual_steps: int = 30  # gradient steps of one person's own model
    most_groups: int = 6  # EM's number of groups is chosen from 1 to this, by the validation people

    def check(self, at: Checker) -> None:
        """Report values that are out of range."""
        at.at_least_one(self, "repeats", "individual_steps", "most_groups")
        at.expect(self.folds >= 2, "folds", "at least 2", self.folds)
        at.not_negative(self, "folds", most=1000)
        at.expect(self.least >= 2, "least", "at least 2: one to tell, one to judge", self.least)
        at.not_negative(self, "least", most=10**6)
        at.expect(bool(self.curve), "curve", "numbers of at least 0", list(self.curve))
        at.each(self, "curve", 0, most=10**6)
        at.expect(0 < self.validation < 1, "validation", "in (0, 1)", self.validation)
        at.expect(bool(self.methods), "methods", "one or more methods", self.methods)
