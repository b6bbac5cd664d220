"""Real people's answers, ready to learn from, and who of the people is held out to judge."""

from dataclasses import dataclass, replace
from typing import Any, cast

import torch
from torch import Tensor

from popl_rl.config import MethodConfig, PeopleConfig
from popl_rl.data.bank import SegmentBank
from popl_rl.data.comparisons import Comparisons
from popl_rl.data.readers.imported import Imported
from popl_rl.keys import ACTION, ANSWER, CONDITION, OBSERVATION, RATER, Answer
from popl_rl.models.policies import PolicySpec
from popl_rl.models.reward_functions import RewardSpec
from popl_rl.randomness import stream

__all__ = ["Fold", "People", "people_of", "split"]


@dataclass(frozen=True)
class People:
    """Real people's answers, ready to learn from and to judge by.

    Attributes:
        spec: Sizes of the hypotheses.
        bank: Segments.
        data: What was read.
        answers: Strict answers of all, a case for each person; what questions refer to.
        names: Name of each person, and of everybody unknown ``?``, ``[C]``.
        groups: Condition of each person, if a column said so; empty text elsewhere, ``[C]``.
    """

    spec: PolicySpec | RewardSpec
    bank: SegmentBank
    data: Imported
    answers: Comparisons
    names: list[str]
    groups: list[str]

    @property
    def known(self) -> Tensor:
        """Which persons are known by an id, ``[C]`` bool."""
        return torch.tensor([name != "?" for name in self.names])


@dataclass(frozen=True)
class Fold:
    """Who is learnt from and who judges.

    Attributes:
        number: Which fold it is.
        held_out: Persons who judge.
        training: Answers to learn from, with soft labels and ties if these count.
        validation: Answers by which scales and numbers are chosen; their people are in neither.
        groups: Condition of each case to learn from, which the oracle alone is told; empty if
            nobody knows.
    """

    number: int
    held_out: list[int]
    training: Comparisons
    validation: Comparisons
    groups: list[str]


def people_of(data: Imported, config: MethodConfig) -> People:
    """Read off what can be learnt from people's answers.

    Args:
        data: Segments, preferences, names.
        config: What hypotheses are, and their hidden layers.

    Raises:
        ValueError: If nothing is known of what is compared, or nobody kept rater ids.
    """
    segments, preferences, names = data
    width, action = segments[OBSERVATION].shape[-1], segments[ACTION]
    if not width:
        raise ValueError(
            "the items have no features; import them with encode=tfidf or encode=<model folder>"
        )
    if RATER not in preferences.keys():  # noqa: SIM118 - not a dict
        raise ValueError(
            "the answers carry no rater ids, and only people whose answers are known to be theirs "
            "can be held out; add a column 'rater', or name groups to simulate (raters=...)"
        )
    discrete = not action.is_floating_point()
    sizes = int(action.max()) + 1 if discrete else action.shape[-1]
    spec: PolicySpec | RewardSpec = PolicySpec(width, sizes, discrete, tuple(config.hidden))
    if config.learns == "reward" or (discrete and sizes == 1):
        inputs, outputs = (width, sizes) if discrete else (width + sizes, 1)
        spec = RewardSpec(inputs, outputs, tuple(config.hidden))
    answers = Comparisons.from_preferences(preferences, cases="rater")
    strict = preferences[ANSWER] <= Answer.SECOND
    who = preferences[RATER][strict]
    named = names.raters or [str(number) for number in range(int(who.max()) + 1)]
    first = torch.full((answers.num_cases,), len(who)).scatter_reduce(
        0, answers.case, torch.arange(len(who)), "amin"
    )
    person = ["?" if code < 0 else named[code] for code in who[first].tolist()]
    groups = [""] * len(person)
    if CONDITION in preferences.keys(True):
        codes = preferences[CONDITION][strict][first].tolist()
        groups = [
            "" if code < 0 else names.conditions[code] if names.conditions else str(code)
            for code in codes
        ]
    return People(spec, spec.bank(segments), data, answers, person, groups)


def split(people: People, config: PeopleConfig, number: int, *, ties: str, seed: int) -> Fold:
    """Hold some people out, and of the others some to choose scales by.

    Args:
        people: Everybody.
        config: How many folds, and who can be held out.
        number: Which fold, from 0.
        ties: Whether ties and soft labels count in training, see
            `popl_rl.data.comparisons.Comparisons.from_preferences`.
        seed: Seed of the folds.

    Raises:
        ValueError: If there are fewer people with enough answers than folds.
    """
    size = people.answers.sizes()
    able = (people.known & (size >= config.least)).nonzero()[:, 0]
    if len(able) < config.folds:
        raise ValueError(
            f"people.folds={config.folds} needs as many people with {config.least} strict answers "
            f"(people.least) or more, got {len(able)}; lower either"
        )
    able = able[torch.randperm(len(able), generator=stream(seed, "folds of people"))]
    held_out = able[number :: config.folds].sort().values
    others = torch.ones(people.answers.num_cases, dtype=torch.bool)
    others[held_out] = False
    rest = others.nonzero()[:, 0]
    rest = rest[torch.randperm(len(rest), generator=stream(seed, f"validation people/{number}"))]
    chosen = torch.zeros_like(others)
    chosen[rest[: max(1, round(config.validation * len(rest)))]] = True
    everything = Comparisons.from_preferences(
        people.data.preferences, cases="rater", ties=cast("Any", ties)
    )
    # Cases of people with ties alone have no number among the strict answers.
    has_ties = ties != "drop" and everything.stage is None
    learnt = _of_people(everything, people, others & ~chosen) if has_ties else None
    training = learnt or _some(people.answers, others & ~chosen)
    groups = []
    if learnt is None and any(people.groups):
        groups = [people.groups[case] for case in (others & ~chosen).nonzero()[:, 0].tolist()]
    return Fold(number, held_out.tolist(), training, _some(people.answers, chosen), groups)


def _some(answers: Comparisons, chosen: Tensor) -> Comparisons:
    """Answers of some cases, which are numbered anew."""
    kept = answers.rows(chosen[answers.case].nonzero()[:, 0])
    case = kept.case.unique(return_inverse=True)[1]
    return replace(kept, case=case, num_cases=int(case.max()) + 1)


def _of_people(everything: Comparisons, people: People, chosen: Tensor) -> Comparisons:
    """The same people's answers with ties and soft labels."""
    preferences = people.data.preferences
    strict = preferences[ANSWER] <= Answer.SECOND
    counted = preferences[ANSWER] <= Answer.TIE
    # Both number the same raters, each from 0 and in the same order, unknown ones behind.
    known = preferences[RATER] >= 0
    among = preferences[RATER][counted & known].unique()
    there = preferences[RATER][strict & known].unique()
    allowed = torch.zeros(everything.num_cases, dtype=torch.bool)
    allowed[: len(among)] = True
    place = torch.searchsorted(among, there)
    allowed[place] = chosen[: len(there)]
    # Whoever is unknown may be learnt from unless chosen to validate; of these, strict answers
    # come in the same order.
    unknown = preferences[RATER][counted] < 0
    is_strict = (preferences[ANSWER][counted] <= Answer.SECOND)[unknown]
    rest = torch.ones(len(is_strict), dtype=torch.bool)
    rest[is_strict] = chosen[len(there) :]
    allowed[len(among) :] = rest
    return _some(everything, allowed)
