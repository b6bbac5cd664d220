"""What new raters are given after questions that were chosen for them, instead of drawn."""

from collections.abc import Sequence

import torch
from tensordict import TensorDict
from torch import Tensor

from popl_rl.data.bank import SegmentBank
from popl_rl.keys import ANSWER, PAIR, Answer
from popl_rl.models.hypothesis_set import HypothesisSet
from popl_rl.models.preference_likelihood import log_likelihood
from popl_rl.models.questions import CANDIDATES, Behaviours, best_question
from popl_rl.randomness import stream
from popl_rl.raters.groups import RaterGroup
from popl_rl.raters.pairs import PairPool
from popl_rl.raters.people import Raters

__all__ = ["CHOICE", "ask_new_raters", "chosen_answers"]

#: Value of the column ``choice``: posterior catering to answers to questions that were chosen by
#: information gain.
CHOICE = "information_gain"


def chosen_answers(
    margin: Tensor,
    pairs: Tensor,
    replies: Tensor,
    *,
    answers: int,
    rule: str = "information_gain",
    generator: torch.Generator | None = None,
) -> TensorDict:
    """What one rater answers to questions that are chosen one after the other.

    Args:
        margin: Margins of the first over the second segment of P candidates, ``[N, P]``.
        pairs: The candidates, ``[P, 2]``.
        replies: What the rater answers to each, ``[P]``; ties and skips tell nothing and are not
            counted.
        answers: Strict answers K; fewer if candidates do not give as many.
        rule: How questions are chosen, see ``popl_rl.models.questions``.
        generator: Source of uniform choices.

    Returns:
        TensorDict ``[K or fewer]`` with ``pair`` and ``answer``, in the order of asking.
    """
    behaviours = Behaviours(margin)
    # A tie changes no belief, so that the next question is the best of the others.
    open_ = replies <= Answer.SECOND
    said = log_likelihood(torch.where(replies == Answer.FIRST, margin, -margin))
    log_weight, order = torch.zeros(len(margin)), []
    for _ in range(min(answers, int(open_.sum()))):
        weights = log_weight.softmax(0)
        index, _ = best_question(behaviours, weights, open_, rule=rule, generator=generator)
        order.append(index)
        open_[index] = False
        log_weight = log_weight + said[:, index]
    return TensorDict({PAIR: pairs[order], ANSWER: replies[order]}, [len(order)])


def ask_new_raters(
    hypotheses: HypothesisSet,
    groups: Sequence[RaterGroup],
    bank: SegmentBank,
    scores: Tensor,
    segment_utility: Tensor,
    *,
    raters: int,
    curve: Sequence[int],
    pool: PairPool | None = None,
    candidates: int = CANDIDATES,
    rule: str = "information_gain",
    seed: int,
) -> dict[tuple[str, int], Tensor]:
    """Members given to new raters of each group after so many answers to chosen questions.

    Args:
        hypotheses: What is chosen from, and whose disagreement decides what is asked.
        groups: G groups.
        bank: N segments.
        scores: Of each segment in each hypothesis's eyes, ``[P, N]``.
        segment_utility: Utility of each segment to each group, ``[G, N]``.
        raters: New raters of each group.
        curve: Numbers of answers.
        pool: What candidates are drawn from; all pairs of the N segments if None.
        candidates: Pairs that one rater's questions are chosen from.
        rule: How they are chosen.
        seed: Of the candidates and the raters' randomness.

    Returns:
        ``[G, raters]`` by ``(CHOICE, answers)``.

    Raises:
        ValueError: If a rater answers nothing but ties and skips.
    """
    pool = PairPool(segment_utility.shape[1]) if pool is None else pool
    picks: dict[tuple[str, int], list[int]] = {(CHOICE, answers): [] for answers in curve}
    for index, group in enumerate(groups):
        generator = stream(seed, f"chosen questions/{index}")
        person = Raters(tuple(groups), torch.tensor([index]))
        nobody = torch.zeros(candidates, dtype=torch.long)
        for _ in range(raters):
            pairs = pool.draw(candidates, generator=generator)
            replies = person.answer(pairs, nobody, segment_utility, generator=generator)
            margin = scores[:, pairs[:, 0]] - scores[:, pairs[:, 1]]
            said = chosen_answers(
                margin, pairs, replies, answers=max(curve), rule=rule, generator=generator
            )
            if not len(said):
                raise ValueError(
                    f"a rater of group {group.name!r} gave no strict answer to {candidates} "
                    "queries; lower the tie and skip thresholds"
                )
            for answers in curve:
                choice = hypotheses.cater(bank, said[:answers], scores=scores)
                picks[CHOICE, answers].append(choice.member)
    return {point: torch.tensor(chosen).view(len(groups), -1) for point, chosen in picks.items()}
