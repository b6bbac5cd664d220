"""What members of a set want of texts, and the pairs that tell them apart."""

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from popl_rl.experiments.people import People
from popl_rl.models.hypothesis_set import HypothesisSet
from popl_rl.models.scoring import segment_scores

__all__ = ["telling_pairs", "text_scores", "wants"]

_SHOWN = 300  # characters of a text in a report


def text_scores(found: HypothesisSet, people: People) -> Tensor:
    """Score of every text in each member's eyes, ``[N, texts]``."""
    return segment_scores(found.population, people.bank, alpha=found.alpha, discount=found.discount)


def wants(scores: Tensor, texts: list[str]) -> pd.DataFrame:
    """What members prefer, in properties that anybody can see.

    Args:
        scores: Of every text in each member's eyes, ``[N, texts]``.
        texts: The texts.

    Returns:
        A row for each member: the rank correlation of its scores with the texts' ``length``, length
        of ``words``, ``questions`` and ``exclamations``, share of ``capitals``, and sentences.
    """
    properties = pd.DataFrame(
        {
            "length": [len(text) for text in texts],
            "words": [np.mean([len(word) for word in text.split()] or [0]) for text in texts],
            "questions": [text.count("?") for text in texts],
            "exclamations": [text.count("!") for text in texts],
            "capitals": [
                sum(letter.isupper() for letter in text) / max(1, len(text)) for text in texts
            ],
            "sentences": [text.count(".") + text.count("!") + text.count("?") for text in texts],
        }
    )
    ranks = properties.rank()
    rows = []
    for member in scores:
        own = pd.Series(member.numpy()).rank()
        rows.append({name: own.corr(ranks[name]) for name in properties})
    return pd.DataFrame(rows).round(2)


def telling_pairs(
    scores: Tensor, people: People, *, one: int, other: int, count: int = 3
) -> list[tuple[str, str]]:
    """Pairs that people were asked about and on which two members disagree most.

    Args:
        scores: Of every text in each member's eyes, ``[N, texts]``.
        people: With the pairs and the texts.
        one: A member.
        other: Another member.
        count: Pairs.

    Returns:
        Beginnings of the text that ``one`` prefers and of the one that ``other`` prefers.
    """
    texts = people.data.names.texts
    pair = torch.stack([people.answers.preferred, people.answers.other], 1)
    pair = torch.cat([pair, pair.flip(1)]).unique(dim=0)
    margin = scores[:, pair[:, 0]] - scores[:, pair[:, 1]]
    margin = margin / margin.std(1, keepdim=True)
    apart = torch.minimum(margin[one], -margin[other])
    chosen = pair[apart.argsort(descending=True)[:count]].tolist()
    return [(texts[left][:_SHOWN], texts[right][:_SHOWN]) for left, right in chosen]
