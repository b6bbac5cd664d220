"""Settings of where data come from: the environment, the raters, the segments."""

from dataclasses import dataclass, field
from math import inf, isfinite
from pathlib import Path
from sys import float_info
from typing import Any

from popl_rl.config.checks import MOST, Checker

__all__ = ["DataConfig", "EnvConfig", "PPOSettings", "RatersConfig", "ResponseConfig"]


@dataclass
class PPOSettings:
    """How PPO learns what a group of raters wants in an environment, for reference."""

    frames: int = 100_000  # steps in the environment for each group
    discount: float = 0.99  # factor of the next step's utility relative to this one's
    learning_rate: float = 3e-3  # of Adam at the start; falls linearly to 0
    action_std: float = 0.5  # standard deviation of continuous actions while it learns
    store: str = "runs/ppo"  # folder in which policies are kept for all runs

    def check(self, at: Checker) -> None:
        """Report values that are out of range."""
        at.at_least_one(self, "frames")
        at.share(self, "discount")
        at.positive(self, "learning_rate", most=10)
        at.positive(self, "action_std", most=1000)
        at.expect(bool(self.store), "store", "a folder", self.store)


@dataclass
class EnvConfig:
    """Which environment, and how long an episode may be."""

    factory: str = "two_doors"  # registered name, module:attr or file.py:attr
    options: dict[str, Any] = field(default_factory=dict)  # arguments of the factory
    data_options: dict[str, Any] = field(default_factory=dict)  # on top of these, for data only
    # What the data show: references, see popl_rl.experiments.behaviours; empty for what the
    # environment itself offers.
    behaviours: list[str] = field(default_factory=list)
    noise: list[float] = field(default_factory=lambda: [0.0])  # levels at which each of them acts
    # Share of behaviours in the data, by name or pattern; all alike if empty or null.
    mixture: dict[str, float] | None = field(default_factory=dict)
    id: str | None = None  # id of a Gymnasium environment, for env=gym
    # Reference of a frozen feature extractor, file.py:attr or module:attr: what is observed are its
    # features of what the environment shows; null for none.
    features: str | None = None
    max_steps: int = 60  # steps after which an episode is cut
    success: str = "goal"  # number in info that is positive when the task is done
    door: str | None = None  # integer in info whose values are worth a row in the table
    measured: list[str] = field(default_factory=list)  # numbers in info whose mean and peak are
    ppo: PPOSettings = field(default_factory=PPOSettings)

    def check(self, at: Checker) -> None:
        """Report values that are out of range."""
        at.at_least_one(self, "max_steps")
        self.ppo.check(at.below("ppo"))
        reference = "a reference, such as env.factory=my_env.py:make"
        at.expect(bool(self.factory), "factory", reference, self.factory)
        if self.factory == "gymnasium:make":
            name = "the id of a Gymnasium environment, such as env.id=CartPole-v1"
            at.expect(bool(self.id), "id", name, self.id)
        if self.id is not None:
            at.expect(bool(self.id), "id", "an id, or null", self.id)
        if self.features is not None:
            named = "a reference, such as env.features=my.py:extract, or null"
            at.expect(":" in self.features, "features", named, self.features)
        at.expect(all(self.behaviours), "behaviours", "references", self.behaviours)
        for name, given in (("behaviours", self.behaviours), ("noise", self.noise)):
            at.expect(len(set(given)) == len(given), name, "different from each other", given)
        at.expect(bool(self.noise), "noise", "levels, [0] for none", self.noise)
        at.each(self, "noise", 0)
        if self.mixture:
            proper = all(share >= 0 for share in self.mixture.values())
            proper = proper and abs(sum(self.mixture.values()) - 1) < 1e-6
            expected = "non-negative shares that sum to 1"
            at.expect(proper, "mixture", expected, dict(self.mixture))


@dataclass
class ResponseConfig:
    """How raters answer: B-Pref's model (Lee et al., 2021), the same for all groups."""

    rationality: float = float("inf")  # beta of the Bernoulli answer; inf always tells the truth
    mistake: float = 0.0  # chance that an answer is flipped
    myopia: float = 1.0  # gamma; below 1 the end of a segment weighs more
    tie: float = 0.0  # differences up to this are ties
    skip: float | None = None  # pairs in which both are worth no more than this are skipped

    def check(self, at: Checker) -> None:
        """Report values that are out of range."""
        at.positive(self, "rationality", most=inf)
        at.expect(0 <= self.mistake <= 1, "mistake", "in [0, 1]", self.mistake)
        at.share(self, "myopia")
        at.not_negative(self, "tie", most=float_info.max)
        if self.skip is not None:
            at.expect(isfinite(self.skip), "skip", "a finite number, or null", self.skip)


@dataclass
class RatersConfig:
    """Who is asked, and what they want."""

    groups: list[str] = field(default_factory=list)  # references of rater functions; empty where
    # real people have answered (data.load)
    shares: list[float] | None = None  # chance of each group; equal if null
    count: int = 200  # raters
    answers: int = 20  # answers of each
    label: str = "regret"  # what raters compare by: regret or return
    response: ResponseConfig = field(default_factory=ResponseConfig)

    def check(self, at: Checker) -> None:
        """Report values that are out of range."""
        at.at_least_one(self, "count", "answers")
        repeated = len(set(self.groups)) < len(self.groups)
        at.expect(not repeated, "groups", "different groups", self.groups)
        if self.shares is not None:
            expected = f"one number per group ({len(self.groups)})"
            at.expect(len(self.shares) == len(self.groups), "shares", expected, self.shares)
            proper = all(share >= 0 for share in self.shares) and abs(sum(self.shares) - 1) < 1e-6
            at.expect(proper, "shares", "non-negative and sum to 1", self.shares)
            somebody = not proper or all(share > 0 for share in self.shares)
            cure = "positive: leave out of raters.groups whom nobody belongs to"
            at.expect(somebody, "shares", cure, self.shares)
        at.expect(self.label in ("regret", "return"), "label", "regret or return", self.label)
        self.response.check(at.below("response"))


@dataclass
class DataConfig:
    """The segments that raters see."""

    segments: int = 4000  # segments to collect
    length: int = 12  # steps of a segment
    memmap: str | None = None  # folder for memory-mapped storage; in memory if null
    load: str | None = None  # folder 'data' of an earlier run: its segments and preferences
    reader: str | None = None  # reference of kind reader, for other data in load; null for a folder
    # of ours, or the reader that fits a file
    reader_options: dict[str, Any] = field(default_factory=dict)  # further arguments of the reader
    save: bool = True  # keep segments and preferences in the run folder
    store: str | None = None  # folder in which segments are kept for other runs; none if null
    seed: int | None = None  # of the segments; that of the run if null

    def check(self, at: Checker) -> None:
        """Report values that are out of range."""
        at.at_least_one(self, "length", most=10**6)
        at.expect(self.segments >= 2, "segments", "at least 2, to compare", self.segments)
        at.expect(self.segments <= MOST, "segments", f"at most {MOST:g}", self.segments)
        at.seed(self)
        if self.load is not None:
            folder = "the folder 'data' of an earlier run, or other data with data.reader"
            found = (Path(self.load) / "segments").is_dir() or Path(self.load).is_file()
            if self.reader is not None:
                folder, found = "something that the reader can read", Path(self.load).exists()
            at.expect(found, "load", folder, self.load)
        given = self.load is not None or self.reader is None
        at.expect(given, "reader", "null without data.load", self.reader)
