"""Which pair to ask a person about next: what is worth most for finding that person's hypothesis.

A person is believed to want what hypothesis n says with probability ``q_n``, and an answer "first"
to pair i is then as likely as catering reckons, ``p_ni``. The *information gain* of a question is
the mutual information of its answer and the hypothesis, ``H(sum_n q_n p_ni) - sum_n q_n H(p_ni)``
in bits (Lindley, 1956; for preferences Bıyık et al., 2019, arXiv 1910.04365): a question is good if
the answer is uncertain because hypotheses differ, not because each of them is unsure. Others are
here to compare with: *volume removal* (Sadigh et al., 2017), the *expected maximum* of the belief
after the answer, and *uniform* draws.

Hypotheses that would answer all candidates alike cannot be told apart by any of them, and need not
be: they count as one.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from popl_rl.models.preference_likelihood import MISTAKE, log_likelihood
from popl_rl.selection.behaviours import label_behaviours

__all__ = [
    "CANDIDATES",
    "ENOUGH",
    "RULES",
    "Behaviours",
    "Question",
    "best_question",
    "chance_of_first",
    "expected_maximum",
    "information_gain",
    "volume_removal",
]

#: Pairs that are looked at before one is asked.
CANDIDATES = 500
#: Belief in one behaviour from which on nothing more is asked.
ENOUGH = 0.9


@dataclass(frozen=True)
class Question:
    """A pair worth asking about.

    Attributes:
        pair: Rows of the two segments, ``[2]``.
        value: What the rule says that it is worth; bits for information gain.
        weights: Belief in each hypothesis before it is answered, ``[N]``.
    """

    pair: Tensor
    value: float
    weights: Tensor


def chance_of_first(margin: Tensor, mistake: float = MISTAKE) -> Tensor:
    """Chance that people answer "first", of any shape.

    Args:
        margin: Margins of the first segment over the second.
        mistake: Chance of a slip, in [0, 0.5), as in catering.

    Raises:
        ValueError: If ``mistake`` is outside [0, 0.5).
    """
    return log_likelihood(margin, mistake).exp()


def information_gain(chance: Tensor, belief: Tensor) -> Tensor:
    """Mutual information of answer and hypothesis in bits, ``[P]``.

    Args:
        chance: Chance that each hypothesis answers "first" to each pair, ``[N, P]``.
        belief: Belief in each hypothesis, ``[N]``, summing to 1.
    """
    return _entropy(belief @ chance) - belief @ _entropy(chance)


def volume_removal(chance: Tensor, belief: Tensor) -> Tensor:
    """Belief that is taken away by the answer that takes less, ``[P]``; arguments as above."""
    first = belief @ chance
    return torch.minimum(first, 1 - first)


def expected_maximum(chance: Tensor, belief: Tensor) -> Tensor:
    """Chance that the most believed is right after the answer, ``[P]``; arguments as above."""
    joint = belief.unsqueeze(1) * chance
    return joint.amax(0) + (belief.unsqueeze(1) - joint).amax(0)


#: What a question is worth, by name; ``uniform`` is no rule but a draw.
RULES: Mapping[str, Callable[[Tensor, Tensor], Tensor]] = {
    "information_gain": information_gain,
    "volume_removal": volume_removal,
    "expected_maximum": expected_maximum,
}


class Behaviours:
    """Hypotheses that would answer all candidates alike, merged.

    Args:
        margin: Margins of the first over the second segment of P candidates, ``[N, P]``.
        mistake: Chance of a slip.

    Attributes:
        label: Behaviour of each hypothesis, ``[N]``.
        chance: Chance that each hypothesis answers "first", ``[N, P]``.
    """

    def __init__(self, margin: Tensor, *, mistake: float = MISTAKE) -> None:
        self.label = label_behaviours((margin > 0).to(torch.uint8))[0]
        self.chance = chance_of_first(margin, mistake)

    def __len__(self) -> int:
        return int(self.label.max()) + 1

    def belief(self, weights: Tensor) -> Tensor:
        """Belief in each of B behaviours, ``[N] -> [B]``."""
        return weights.new_zeros(len(self)).index_add_(0, self.label, weights)

    def values(self, weights: Tensor, rule: str) -> Tensor:
        """What each candidate is worth by a rule, ``[P]``.

        A behaviour answers as its hypotheses do on average, by the belief in them.

        Raises:
            ValueError: If there is no such rule.
        """
        if rule not in RULES:
            raise ValueError(f"rule must be uniform, {', '.join(RULES)}, got {rule!r}")
        belief = self.belief(weights)
        joint = weights.unsqueeze(1) * self.chance
        total = joint.new_zeros(len(self), joint.shape[1]).index_add_(0, self.label, joint)
        return RULES[rule](total / belief.clamp(min=1e-30).unsqueeze(1), belief)


def best_question(
    behaviours: Behaviours,
    weights: Tensor,
    open_: Tensor,
    *,
    rule: str = "information_gain",
    generator: torch.Generator | None = None,
) -> tuple[int, float]:
    """The candidate to ask about, and what it is worth.

    Args:
        behaviours: What hypotheses would answer to P candidates.
        weights: Belief in each hypothesis, ``[N]``.
        open_: Whether each candidate may still be asked, bool ``[P]``.
        rule: A name in ``RULES``, or ``"uniform"``.
        generator: Source of the draw, for ``"uniform"`` alone.

    Raises:
        ValueError: If nothing may be asked, ``rule`` is unknown or ``generator`` is missing.
    """
    if not bool(open_.any()):
        raise ValueError("open_ must leave a candidate to ask about, got none; draw more pairs")
    if rule == "uniform":
        if generator is None:
            raise ValueError("generator must be given for rule='uniform'")
        return int(torch.multinomial(open_.float(), 1, generator=generator)), 0.0
    values = behaviours.values(weights, rule).masked_fill(~open_, -torch.inf)
    chosen = int(values.argmax())
    return chosen, float(values[chosen])


def _entropy(chance: Tensor) -> Tensor:
    """Entropy of a yes or no in bits."""
    nats: Tensor = torch.special.entr(chance) + torch.special.entr(1 - chance)
    return nats / math.log(2)
