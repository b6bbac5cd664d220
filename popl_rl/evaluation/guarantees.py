"""What a set guarantees: members that no other serves every rater at least as well as.

Lexicase selects parents that no other member of the *population* dominates over the raters who
answered. Whether what is returned is still so for other people with other questions, and beside
policies that the population never held, is not guaranteed, but can be counted.
"""

import torch
from torch import Tensor

from popl_rl.data.bank import SegmentBank
from popl_rl.data.comparisons import Comparisons
from popl_rl.evaluation.evaluator import Evaluator
from popl_rl.evaluation.held_out_raters import draw_held_out_raters
from popl_rl.models.hypothesis_set import HypothesisSet
from popl_rl.models.scoring import pass_shares, segment_scores
from popl_rl.randomness import stream
from popl_rl.selection.behaviours import label_behaviours

__all__ = ["guarantees", "undominated"]


def undominated(values: Tensor) -> Tensor:
    """Which of P vectors no other dominates: is at least as high everywhere, and higher somewhere.

    Args:
        values: ``[P, C]``, higher is better.

    Returns:
        bool ``[P]``; of equal vectors none dominates the other.
    """
    dominated = [
        bool(((values >= own).all(1) & (values > own).any(1)).any()) for own in values.unbind()
    ]
    return ~torch.tensor(dominated, dtype=torch.bool)


def guarantees(
    found: HypothesisSet,
    oracles: HypothesisSet,
    evaluator: Evaluator,
    *,
    bank: SegmentBank,
    training: Comparisons,
) -> dict[str, float]:
    """Count members that are not dominated, by whom they are judged.

    Args:
        found: P hypotheses.
        oracles: One hypothesis for each of G groups, trained with its true answers.
        evaluator: Knows the groups, and has segments of its own.
        bank: The segments that the learner saw.
        training: Comparisons of the raters that it learnt from, a case for each of them.

    Returns:
        By measure: ``members`` that differ in how they rank what fresh raters are asked, and of
        these ``undominated_training`` over the raters learnt from, ``undominated`` over as many
        fresh raters of the same groups with as many answers to fresh questions, and
        ``undominated_beside_oracles`` over the exact accuracies on the G groups' held-out pairs,
        where the oracles may dominate too: what is left of a local optimum in a global one. Beside
        them ``best_accuracy`` of the set and ``oracle_accuracy``, means over groups.
    """
    people = draw_held_out_raters(
        evaluator.groups,
        evaluator.segment_utility,
        raters=training.num_cases,
        answers=max(1, round(len(training) / training.num_cases)),
        shares=evaluator.shares,
        pool=evaluator.pool,
        generator=stream(evaluator.seed, "guarantees"),
    )
    fresh = Comparisons.from_preferences(people, cases="rater")
    scores = evaluator.scores(found)
    distinct = label_behaviours(scores[:, fresh.preferred] > scores[:, fresh.other])[1]
    learnt_from = segment_scores(
        found.population, bank, alpha=found.alpha, discount=found.discount
    ).cpu()
    accuracy, best = evaluator.accuracy(found), evaluator.accuracy(oracles)
    beside = undominated(torch.cat([accuracy[distinct], best]))[: len(distinct)]
    counted = {
        "undominated_training": undominated(pass_shares(learnt_from, training).values[distinct]),
        "undominated": undominated(pass_shares(scores, fresh).values[distinct]),
        "undominated_beside_oracles": beside,
    }
    return {
        "members": float(len(distinct)),
        **{measure: float(which.sum()) for measure, which in counted.items()},
        "best_accuracy": float(accuracy.amax(0).mean()),
        "oracle_accuracy": float(best.diagonal().mean()),
    }
