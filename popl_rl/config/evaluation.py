"""Settings of how the result is evaluated."""

from dataclasses import dataclass, field
from pathlib import Path

from popl_rl.config.checks import Checker

__all__ = ["EvaluationConfig"]


@dataclass
class EvaluationConfig:
    """How the result is judged."""

    episodes: int = 200  # episodes per policy
    new_raters: int = 20  # new raters of each group that the set is catered to
    answers: int = 20  # answers of each of them
    # Numbers of answers that catering is measured at besides, on the same new raters; [] for none.
    curve: list[int] = field(default_factory=lambda: [1, 2, 5, 10, 20, 50])
    curve_members: int = 40  # members that are rolled out for these curves at most
    pairs: int = 4000  # fresh pairs per group for accuracies
    menu: int = 10  # items that a reward function chooses from, where there is nothing to do
    optimiser: str = "auto"  # how reward functions act: plan, ppo; auto: plan if there is a table
    ppo_frames: int = 100_000  # frames of PPO for each of them
    greedy: bool = False  # most likely actions instead of sampled ones
    reference: str = "random"  # whose return is a recovery of 0: random; clone: of the data's
    # typical behaviour; others: the oracle of whichever other group suits a group least
    baselines: bool = True  # train pooled CPL and the oracle too
    baselines_from: str | None = None  # folder 'baselines' of a run on the same data; not trained
    # Policies that PPO trains on each group's utility too (env.ppo), kept for all runs.
    ppo_reference: bool = False
    reward_baselines: bool = True  # B-REX and DPL too, where items are judged
    brex_steps: int = 10_000  # steps of B-REX's chain
    dpl_steps: int = 500  # steps of DPL's training
    figures: bool = True  # draw pictures
    animate: bool = False  # an animated GIF for each group, where there is a renderer
    # Answers up to which the method is trained on fewer of them too, to tell how many are missing;
    # 0 for never.
    learning_curve: int = 1000
    history: int = 10  # generations between two snapshots for the pictures; 0 for none

    def check(self, at: Checker) -> None:
        """Report values that are out of range."""
        at.at_least_one(self, "episodes", "new_raters", "answers", "pairs", "curve_members")
        at.at_least_one(self, "ppo_frames", "brex_steps", "dpl_steps")
        at.each(self, "curve", 1, most=10**6)
        at.expect(self.menu >= 2, "menu", "at least 2, to choose", self.menu)
        at.expect(self.menu <= 10**6, "menu", "at most 1e+06", self.menu)
        at.one_of(self, "optimiser", ("auto", "plan", "ppo"))
        at.one_of(self, "reference", ("random", "clone", "others"))
        at.not_negative(self, "history", "learning_curve")
        if self.baselines_from is not None:
            expected = "the folder 'baselines' of an earlier run"
            # Each kind of set says what it is in a file of such a name.
            found = any(Path(self.baselines_from).glob("*_set.json"))
            at.expect(found, "baselines_from", expected, self.baselines_from)
