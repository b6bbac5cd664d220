"""The learning curve of a run: the same method, trained on fewer answers of each rater."""

import warnings
from dataclasses import replace
from math import ceil
from pathlib import Path

import torch
from torch import Tensor

from popl_rl.accessories import accessory
from popl_rl.config import Config
from popl_rl.data.comparisons import Comparisons
from popl_rl.evaluation.evaluator import Evaluator
from popl_rl.evaluation.held_out_raters import met_answers
from popl_rl.evaluation.learning_curves import LearningCurve, fit_learning_curve
from popl_rl.experiments.builders import build_method
from popl_rl.experiments.progress import Progress
from popl_rl.experiments.steps import Setting
from popl_rl.keys import RATER
from popl_rl.models.hypothesis_set import HypothesisSet
from popl_rl.randomness import stream
from popl_rl.storage import write_atomic

__all__ = ["fewer_answers", "learning_curve", "missing_answers"]

_SHARES = (0.25, 0.5, 0.8)  # of each rater's answers, rounded up, beside all of them
_LEAST = 2  # answers of each: with a single one nobody knows what else the same rater wants


def missing_answers(
    config: Config, setting: Setting, found: HypothesisSet, run_dir: Path
) -> str | None:
    """Say how many answers are missing by the ``learning_curve``, or None if none are.

    Warns:
        UserWarning: If it cannot be told, as where a method refuses so few answers.
    """
    with accessory("how many answers are missing is not told", "set evaluation.learning_curve=0"):
        curve = learning_curve(config, setting, found, run_dir)
        if curve is not None:
            return curve.warning(setting.problem.comparisons.num_cases)
    return None


def learning_curve(
    config: Config, setting: Setting, found: HypothesisSet, run_dir: Path
) -> LearningCurve | None:
    """Train on fewer answers of each rater, and see where more would lead.

    What each set makes of new raters is measured by their answers alone, so that it could be with
    people. Writes ``learning_curve.csv``.

    Args:
        config: The run's configuration; ``evaluation.learning_curve`` says up to how many
            answers this is done; a ranking is one, and so is a tie.
        setting: With the data and the evaluator.
        found: The set that was learnt from all answers.
        run_dir: Folder of the run.

    Returns:
        The curve; None if there are too many answers, no rater ids, or too few answers of each
        rater to leave some out.
    """
    problem = setting.problem
    if (
        problem.comparisons.num_answers > config.evaluation.learning_curve
        or config.method.cases != "rater"
    ):
        return None
    subsets = _subsets(problem.comparisons, seed=config.seed)
    if len(subsets) < 2:
        return None
    sets = []
    with Progress("learning curve", total=len(subsets)) as progress:
        for count, comparisons in enumerate(subsets, start=1):
            method = build_method(
                config.method,
                replace(problem, comparisons=comparisons),
                num_groups=len(setting.groups),
                generator=stream(config.seed, f"learning curve/{count}", config.device),
            )
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # what they say of fewer answers is no news
                while method.generation < method.generations:
                    method.step()
                sets.append(method.result())
            progress.update(count)
    wrong = [_wrong(setting.evaluator, one) for one in [*sets, found]]
    curve = fit_learning_curve(
        [one.num_answers for one in [*subsets, problem.comparisons]],
        [float(one.mean()) for one in wrong],
        # Without any spread one answer more or less counts as its error.
        [max(float(one.std() / len(one) ** 0.5), 1 / one.numel() ** 2) for one in wrong],
    )
    rows = zip(curve.answers, curve.wrong, curve.error, strict=True)
    lines = [f"{answers},{share:.6f},{error:.6f}\n" for answers, share, error in rows]
    write_atomic(run_dir / "learning_curve.csv", "".join(["answers,wrong,error\n", *lines]))
    return curve


def fewer_answers(
    comparisons: Comparisons, count: int, *, generator: torch.Generator
) -> Comparisons:
    """Some answers of each rater.

    Args:
        comparisons: M comparisons, a case for each rater.
        count: Answers to keep of each; all of who has given fewer.
        generator: Source of which are kept.

    Returns:
        Their comparisons, in the order that they had; raters keep their numbers.
    """
    # Comparisons of one answer, such as the halves of a tie, stay together.
    own = torch.arange(len(comparisons)) if comparisons.answer is None else comparisons.answer.cpu()
    case = torch.zeros(int(own.max()) + 1, dtype=torch.int64)
    case[own] = comparisons.case.cpu()
    order = torch.randperm(len(case), generator=generator)
    order = order[case[order].argsort(stable=True)]
    first = case.bincount(minlength=comparisons.num_cases).cumsum(0).roll(1)
    first[0] = 0
    place = torch.empty_like(order)
    place[order] = torch.arange(len(order)) - first[case[order]]
    kept = (place[own] < count).nonzero()[:, 0]
    return comparisons.rows(kept.to(comparisons.case.device))


def _subsets(comparisons: Comparisons, *, seed: int) -> list[Comparisons]:
    """Fewer answers of everybody, each part of the next, the smallest first."""
    each = comparisons.num_answers / comparisons.num_cases
    subsets = [
        # The same stream for all, so that the fewer answers are among the more.
        fewer_answers(comparisons, count, generator=stream(seed, "fewer answers"))
        for count in sorted({max(_LEAST, ceil(share * each)) for share in _SHARES})
    ]
    return [one for one in subsets if one.num_answers < comparisons.num_answers]


def _wrong(evaluator: Evaluator, found: HypothesisSet) -> Tensor:
    """Share of each new rater's further answers that their other answers get wrong, ``[R]``."""
    one, other = evaluator.held_out
    moved = other.clone()
    moved[RATER] = moved[RATER] + int(one[RATER].max()) + 1
    asked = Comparisons.from_preferences(torch.cat([one, moved]), cases="rater")
    scores = evaluator.scores(found)
    return 1 - met_answers(scores[:, asked.preferred] - scores[:, asked.other], asked)
