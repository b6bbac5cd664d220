"""Methods trained on real people's answers, and judged by the people who were held out."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from typing import cast

import pandas as pd
import torch
from omegaconf import OmegaConf
from torch import Tensor

from popl_rl.algorithms.cpl import GroupCPL, train
from popl_rl.algorithms.expectation import expect
from popl_rl.algorithms.lore import LoRe
from popl_rl.algorithms.problem import Method, Problem
from popl_rl.algorithms.tie_threshold import with_threshold
from popl_rl.algorithms.vpl import VPL
from popl_rl.config import Config, MethodConfig, PeopleConfig
from popl_rl.data.comparisons import Comparisons
from popl_rl.evaluation.people import (
    Predictor,
    Questions,
    SetPredictor,
    ToldPredictor,
    draw_questions,
    judge,
)
from popl_rl.evaluation.people_models import EncodedPredictor, IndividualPredictor, MixedPredictor
from popl_rl.evaluation.people_statistics import PERSON_COLUMNS
from popl_rl.experiments.builders import build_method, build_problem
from popl_rl.experiments.people import Fold, People
from popl_rl.models.calibration import SCALES
from popl_rl.models.hypothesis_set import HypothesisSet
from popl_rl.models.preference_likelihood import answer_likelihood, log_likelihood, per_case
from popl_rl.models.scoring import margins
from popl_rl.randomness import stream

__all__ = [
    "Trained",
    "as_trained",
    "catered_members",
    "fit_ties",
    "judge_fold",
    "method_config",
    "reference",
    "set_predictors",
    "train_on",
]

_VPL_HIDDEN = (32,)  # where all other hypotheses are linear
_E_STEPS = 30  # of the shares of a finished set's members


@dataclass(frozen=True)
class Trained:
    """What a method found on a fold.

    Attributes:
        label: Name of the method.
        predictors: What predicts new people's answers, by the choice it makes.
        found: The set, if there is one.
    """

    label: str
    predictors: dict[str, Predictor]
    found: HypothesisSet | None = None


def method_config(config: MethodConfig, name: str) -> MethodConfig:
    """Settings of another method, all else as they are.

    Args:
        config: Settings of the run.
        name: A file of ``configs/method``, or the run's own method.

    Raises:
        ValueError: If there is none of this name.
    """
    if name == config.name:
        return config
    entry = files("popl_rl.configs.method") / f"{name}.yaml"
    if not entry.is_file():
        folder = files("popl_rl.configs.method")
        known = sorted(
            each.name.removesuffix(".yaml")
            for each in folder.iterdir()
            if each.name.endswith(".yaml")
        )
        raise ValueError(f"people.methods must be of {', '.join(known)}, got {name!r}")
    base = MethodConfig(
        cases=config.cases,
        ties=config.ties,
        tie_threshold=config.tie_threshold,
        learns=config.learns,
        hidden=config.hidden,
        members=config.members,
        generations=config.generations,
        training=config.training,
        refinement=config.refinement,
    )
    merged = OmegaConf.merge(
        OmegaConf.structured(base), OmegaConf.create(entry.read_text(encoding="utf-8"))
    )
    return cast("MethodConfig", OmegaConf.to_object(merged))


def fit_ties(people: People, fold: Fold, config: Config) -> Fold:
    """The same fold with the threshold of its model of draws, if ties are answers of one."""
    problem = with_threshold(
        build_problem(config.method, people.spec, people.bank, fold.training),
        threshold=config.method.tie_threshold,
        generator=stream(config.seed, f"people/{fold.number}/tie threshold"),
    )
    return replace(fold, training=problem.comparisons)


def train_on(
    people: People,
    fold: Fold,
    config: Config,
    name: str,
    *,
    run: Callable[[Method], HypothesisSet] = train,
) -> Trained:
    """Train a method on a fold, choose its scale, and make it predict.

    Args:
        people: Everybody.
        fold: Whom to learn from.
        config: Settings of the run.
        name: ``pooled_cpl``, ``individual``, ``oracle`` (told the conditions), or a method of
            ``configs/method``.
        run: Runs a method to its end.
    """
    settings = method_config(config.method, config.method.name if name in _SINGLE else name)
    spec = people.spec
    if "vpl" in settings.sections() and not spec.hidden and not spec.output_bias:
        spec = replace(spec, hidden=_VPL_HIDDEN)  # z is added to the inputs of a hidden layer
    if settings.kmeans.groups is None:  # nobody knows how many groups people are of
        settings = replace(settings, kmeans=replace(settings.kmeans, silhouette=True))
    problem = build_problem(settings, spec, people.bank, fold.training)
    generator = stream(config.seed, f"people/{fold.number}/{name}")
    if name == "oracle":
        return _oracle(people, fold, problem, generator)
    if name in _SINGLE:
        weight = torch.ones(1, len(fold.training))
        pooled = run(GroupCPL(problem, weight=weight, generator=generator))
        scale = _scale(_margins(pooled, people, fold.validation), fold.validation)
        pooled.alpha *= scale
        return reference(name, pooled, people, problem, config, scale=scale)
    if name == "em" and settings.em.groups is None:
        return _best_em(people, fold, config, settings, problem, generator, run)
    method = build_method(settings, problem, num_groups=2, generator=generator)
    found = run(method)
    if isinstance(method, VPL | LoRe):
        return Trained(name, _told_by_answers(method, people, fold), found)
    return as_trained(name, found, people, fold, alpha=problem.training.alpha)


def reference(
    name: str,
    pooled: HypothesisSet,
    people: People,
    problem: Problem,
    config: Config,
    *,
    scale: float,
) -> Trained:
    """What methods are compared with: the hypothesis for all, or one for each person.

    Args:
        name: ``pooled_cpl``, or ``individual``, which tunes the former for each person.
        pooled: The hypothesis for all, in the scale in which it is believed.
        people: Everybody.
        problem: What it was learnt from.
        config: Settings of the run.
        scale: The factor by which that is its scale.
    """
    if name == "pooled_cpl":
        predictor = SetPredictor(_margins(pooled, people, people.answers))
        return Trained(name, {"": predictor}, pooled)
    own = IndividualPredictor(
        problem,
        people.answers,
        pooled.population,
        steps=config.people.individual_steps,
        scale=scale,
        seed=config.seed,
    )
    return Trained(name, {"": own}, pooled)


def _told_by_answers(method: VPL | LoRe, people: People, fold: Fold) -> dict[str, Predictor]:
    """A hypothesis for each person, told by an encoder, or with weights fitted to the answers."""

    def predictor(answers: Comparisons, scale: float) -> EncodedPredictor | MixedPredictor:
        if isinstance(method, LoRe):
            return MixedPredictor(method, answers, scale=scale)
        return EncodedPredictor(method, answers, scale=scale)

    validation = _all_questions(fold.validation)
    told = predictor(fold.validation, 1.0).margins(validation, int(validation.told.max()))
    scale = _scale_of_margins(told[validation.mask])
    choice = "fitted" if isinstance(method, LoRe) else "encoder"
    return {choice: predictor(people.answers, scale)}


_SINGLE = ("pooled_cpl", "individual", "oracle")


def _oracle(people: People, fold: Fold, problem: Problem, generator: torch.Generator) -> Trained:
    """One hypothesis for each condition, trained on the answers of people of that condition."""
    names = sorted({*fold.groups} - {""})
    if not names:
        raise ValueError(
            "the oracle is told the conditions that people are of, and none are known; add a "
            "column 'condition', or leave 'oracle' out of people.methods (it needs ties=drop)"
        )
    code = {name: place for place, name in enumerate(names)}
    group = torch.tensor([code.get(name, -1) for name in fold.groups])[fold.training.case]
    weight = torch.stack([(group == place).float() for place in range(len(names))])
    found = train(GroupCPL(problem, weight=weight, generator=generator))
    own = _margins(found, people, fold.training)[group.clamp(min=0), torch.arange(len(group))]
    found.alpha *= _scale_of_margins(own[group >= 0])
    told = torch.tensor([code.get(name, 0) for name in people.groups])
    predictor = ToldPredictor(_margins(found, people, people.answers), told)
    return Trained("oracle", {"": predictor}, found)


def _margins(found: HypothesisSet, people: People, comparisons: Comparisons) -> Tensor:
    return margins(
        found.population, people.bank, comparisons, alpha=found.alpha, discount=found.discount
    )


def _shares(margin: Tensor, comparisons: Comparisons) -> Tensor:
    """Shares of the people whom each member speaks for, by EM with the members as they are."""
    likelihood = per_case(answer_likelihood(margin, comparisons), comparisons)
    share = torch.full((len(margin),), 1 / len(margin))
    for _ in range(_E_STEPS):
        share = expect(likelihood, share).responsibility.mean(1)
    return share


def _scale_of_margins(margin: Tensor) -> float:
    each = torch.stack([log_likelihood(scale * margin).mean() for scale in SCALES])
    return SCALES[int(each.argmax())]


def _scale(margin: Tensor, comparisons: Comparisons) -> float:
    """Scale under which the mixture of the members explains people's answers best."""
    each = []
    for scale in SCALES:
        share = _shares(scale * margin, comparisons)
        likelihood = per_case(answer_likelihood(scale * margin, comparisons), comparisons)
        each.append(expect(likelihood, share).evidence.mean())
    return SCALES[int(torch.stack(each).argmax())]


def as_trained(
    name: str, found: HypothesisSet, people: People, fold: Fold, *, alpha: float
) -> Trained:
    """A set that is catered, that mixes, and of which one serves all; its scale is chosen.

    Args:
        name: Name of the method.
        found: What it has found, in any scale; it gets the chosen one.
        people: Everybody.
        fold: Whom it has learnt from.
        alpha: Scale of the scores in training, which the threshold of ties is for.
    """
    found.alpha *= _scale(_margins(found, people, fold.validation), fold.validation)
    return Trained(name, set_predictors(found, people, fold, alpha=alpha), found)


def set_predictors(
    found: HypothesisSet, people: People, fold: Fold, *, alpha: float
) -> dict[str, Predictor]:
    """What predicts by a set whose scale was chosen, by the choice that it makes.

    Args:
        found: The set.
        people: Everybody.
        fold: Whom it has learnt from.
        alpha: Scale of the scores in training, which the threshold of ties is for.
    """
    learnt = _margins(found, people, fold.training)
    training = fold.training.scaled(found.alpha / alpha)
    prior = _shares(learnt, training).clamp(min=1e-3).log()
    margin = _margins(found, people, people.answers)
    likelihood = per_case(answer_likelihood(learnt, training), training)
    best = int(likelihood.sum(1).argmax())
    return {
        "posterior": SetPredictor(margin, log_prior=prior),
        "mixture": SetPredictor(margin, log_prior=prior, mix=True),
        "single": SetPredictor(margin[[best]]),
    }


def _best_em(
    people: People,
    fold: Fold,
    config: Config,
    settings: MethodConfig,
    problem: Problem,
    generator: torch.Generator,
    run: Callable[[Method], HypothesisSet],
) -> Trained:
    """EM with the number of groups under which the validation people's answers are likeliest."""
    best, most = None, -float("inf")
    for groups in range(1, config.people.most_groups + 1):
        told = replace(settings, em=replace(settings.em, groups=groups))
        method = build_method(told, problem, num_groups=groups, generator=generator)
        found = run(method)
        margin = _margins(found, people, fold.validation)
        margin = _scale(margin, fold.validation) * margin
        training = fold.training.scaled(found.alpha / problem.training.alpha)
        share = _shares(_margins(found, people, training), training)
        likelihood = per_case(answer_likelihood(margin, fold.validation), fold.validation)
        value = float(expect(likelihood, share).evidence.mean())
        if value > most:
            best, most = found, value
    assert best is not None
    return as_trained("em", best, people, fold, alpha=problem.training.alpha)


def _all_questions(answers: Comparisons) -> Questions:
    """Questions of everybody with two answers or more, for scales."""
    able = (answers.sizes() >= 2).nonzero()[:, 0].tolist()
    return draw_questions(answers, able, generator=torch.Generator().manual_seed(0))


def catered_members(
    people: People, fold: Fold, found: HypothesisSet, *, alpha: float, answers: int, seed: int
) -> dict[int, int]:
    """The member that each held-out person is given after some answers.

    Args:
        people: Everybody.
        fold: Who is held out.
        found: A set that was trained on the others, as `as_trained` has scaled it.
        alpha: Scale of the scores in training.
        answers: Answers that are told.
        seed: Seed of which they are.

    Returns:
        Member by case of the person.
    """
    posterior = as_trained("", found, people, fold, alpha=alpha).predictors["posterior"]
    assert isinstance(posterior, SetPredictor)
    generator = stream(seed, f"held-out people/{fold.number}")
    questions = draw_questions(people.answers, fold.held_out, most=answers, generator=generator)
    chosen = posterior.belief(questions, answers).argmax(1)
    return dict(zip(questions.person.tolist(), chosen.tolist(), strict=True))


def judge_fold(
    people: People, fold: Fold, trained: Trained, config: PeopleConfig, *, seed: int
) -> pd.DataFrame:
    """How well the held-out people's further answers are predicted.

    Args:
        people: Everybody.
        fold: Who is held out.
        trained: What was learnt from the others.
        config: Numbers of answers that are told.
        seed: Seed of the division of their answers, the same for every method.

    Returns:
        Rows with the columns `popl_rl.evaluation.people_statistics.PERSON_COLUMNS`.
    """
    curve: Sequence[int] = sorted(set(config.curve))
    questions = draw_questions(
        people.answers,
        fold.held_out,
        most=max(*curve, 1),
        repeats=config.repeats,
        generator=stream(seed, f"held-out people/{fold.number}"),
    )
    rows = []
    for choice, predictor in trained.predictors.items():
        for answers in curve:
            found = judge(predictor, questions, answers=answers)
            for case, accuracy, likely in zip(*(each.tolist() for each in found), strict=True):
                who = people.names[case], people.groups[case]
                rows.append((trained.label, choice, fold.number, *who, answers, accuracy, likely))
    return pd.DataFrame(rows, columns=PERSON_COLUMNS)
