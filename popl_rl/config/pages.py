"""Settings of the two pages: ``popl-label`` and ``popl-serve``."""

from dataclasses import dataclass, field
from pathlib import Path

from omegaconf import MISSING

from popl_rl.config.checks import Checker
from popl_rl.config.run import Config

__all__ = ["LabelConfig", "LabelSettings", "PageSettings", "ServeConfig", "ServeSettings"]


@dataclass
class PageSettings:
    """Where a page is to be found, and what it tolerates."""

    host: str = "127.0.0.1"  # address to listen on; 0.0.0.0 for every one of this machine
    port: int = 8000  # 0 for any that is free
    key: str | None = None  # word that visitors need; made up if null and others can reach the page
    language: str = "en"  # en or de, until a visitor chooses another
    rate: float = 20.0  # requests per second of one visitor, on average
    newcomers: int = 120  # visitors who may begin in a minute

    def check(self, at: Checker) -> None:
        """Report values that are out of range."""
        at.expect(bool(self.host), "host", "an address, such as 127.0.0.1", self.host)
        at.expect(0 <= self.port < 65536, "port", "in 0..65535", self.port)
        at.one_of(self, "language", ("en", "de"))
        at.positive(self, "rate")
        at.at_least_one(self, "newcomers")


@dataclass
class LabelSettings:
    """What people are asked, and how."""

    pairs: str = "uniform"  # uniform; start: from the same state; disagreement: of a policy set
    policies: str | None = None  # folder of that set
    count: int = 100  # different pairs
    raters_per_pair: int = 5  # people who compare each
    answers: int = 40  # pairs that one person is asked about at most
    attention: int = 15  # pairs between two attention checks; 0 for none
    pause: int = 20  # answers after which a pause is offered; 0 for never
    instructions: str | None = None  # Markdown file; a page of the library's own if null

    def check(self, at: Checker) -> None:
        """Report values that are out of range."""
        at.one_of(self, "pairs", ("uniform", "start", "disagreement"))
        given = self.policies is not None
        folder = "the folder 'policies' of a run, for pairs=disagreement alone"
        at.expect(given == (self.pairs == "disagreement"), "policies", folder, self.policies)
        at.at_least_one(self, "count", "raters_per_pair", "answers")
        at.not_negative(self, "attention", "pause")
        if self.instructions is not None:
            found = Path(self.instructions).is_file()
            at.expect(found, "instructions", "a Markdown file", self.instructions)


@dataclass
class LabelConfig(Config):
    """What popl-label does; of a run's settings it reads ``env``, ``data`` and ``seed``."""

    out: str = MISSING  # folder of answers and clips; goes on where it was stopped
    label: LabelSettings = field(default_factory=LabelSettings)
    page: PageSettings = field(default_factory=PageSettings)

    def check(self, at: Checker) -> None:
        """Report values that are out of range."""
        at.seed(self)
        for name in ("env", "data", "label", "page"):
            getattr(self, name).check(at.below(name))


@dataclass
class ServeSettings:
    """How a person's policy is found."""

    questions: int = 5  # at most
    enough: float = 0.9  # belief in one policy from which on nothing is asked
    candidates: int = 500  # pairs that questions are chosen from
    segments: int = 150  # segments in these pairs at most: each is rendered once
    further: int = 5  # random pairs that a person is asked about afterwards, to see if it fits
    episodes: int = 50  # of each policy, for the numbers that are shown

    def check(self, at: Checker) -> None:
        """Report values that are out of range."""
        at.at_least_one(self, "questions", "candidates", "episodes")
        at.positive(self, "enough")
        at.expect(self.segments >= 2, "segments", "at least 2, to compare", self.segments)
        at.not_negative(self, "further")


@dataclass
class ServeConfig:
    """What popl-serve does with a finished run."""

    run_dir: str = MISSING  # folder of the run
    serve: ServeSettings = field(default_factory=ServeSettings)
    page: PageSettings = field(default_factory=PageSettings)
    seed: int = 0  # of candidates and clips

    def check(self, at: Checker) -> None:
        """Report values that are out of range."""
        at.seed(self)
        for name in ("serve", "page"):
            getattr(self, name).check(at.below(name))
