"""The folder of ``popl-label``: which pairs are compared, and answers as data to train on."""

import json
import shutil
import tempfile
from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from popl_rl.data.comparisons import Comparisons
from popl_rl.data.pairs import draw_pairs, starts_of
from popl_rl.keys import ANSWER, PAIR, RATER
from popl_rl.models.hypothesis_set import HypothesisSet
from popl_rl.models.questions import Behaviours
from popl_rl.raters.pairs import PairPool, training_pool
from popl_rl.storage import read_manifest, save_tensordict, write_json
from popl_rl.web.label_store import LabelStore

__all__ = ["choose_pairs", "export", "kept_pairs"]

_CANDIDATES = 20  # for each pair that is asked, where disagreement decides


def choose_pairs(
    segments: TensorDictBase,
    kind: str,
    *,
    count: int,
    policies: HypothesisSet | None = None,
    generator: torch.Generator,
) -> Tensor:
    """Different pairs of segments for people to compare.

    Where segments go on from common states, only those from which people are asked for training are
    used (``popl_rl.raters.pairs.training_pool``).

    Args:
        segments: TensorDict ``[N, T]``.
        kind: ``"uniform"``: any two. ``"start"``: two that go on from the same state.
            ``"disagreement"``: those of many that would tell most about whose member somebody is,
            among pairs from the same state where there are any.
        count: How many, at most.
        policies: Who disagrees, for ``"disagreement"``.
        generator: Source of the pairs.

    Returns:
        ``[count or fewer, 2]``: fewer if there are no more.

    Raises:
        ValueError: If segments do not say which state they go on from, ``policies`` is missing, or
            ``kind`` is unknown.
    """
    start = starts_of(segments)
    if kind == "start" and start is None:
        raise ValueError(
            "label.pairs=start needs segments that say which state they go on from "
            "(('info', 'start')), which these do not; use label.pairs=uniform"
        )
    if kind not in ("uniform", "start", "disagreement"):
        raise ValueError(f"kind must be uniform, start or disagreement, got {kind!r}")
    pool = PairPool(len(segments)) if start is None else training_pool(segments)
    if kind == "uniform" and pool.allowed is not None:
        any_two = draw_pairs(len(pool.allowed), 4 * count, generator=generator)
        return _distinct(pool.allowed[any_two])[:count]
    if kind != "disagreement":
        return _distinct(pool.draw(4 * count, generator=generator))[:count]
    if policies is None:
        raise ValueError("policies must be given for disagreement, got None")
    pairs = _distinct(pool.draw(_CANDIDATES * count, generator=generator))
    comparisons = Comparisons(pairs[:, 0], pairs[:, 1], torch.arange(len(pairs)), len(pairs))
    behaviours = Behaviours(policies.margins(segments, comparisons).cpu())
    weights = torch.full((len(policies),), 1 / len(policies))
    return pairs[behaviours.values(weights, "information_gain").argsort(descending=True)[:count]]


def _distinct(pairs: Tensor) -> Tensor:
    """Each pair once, in whichever order it came first."""
    seen: dict[tuple[int, int], tuple[int, int]] = {}
    for first, second in pairs.tolist():
        seen.setdefault((min(first, second), max(first, second)), (first, second))
    return torch.tensor(list(seen.values())).view(-1, 2)


def kept_pairs(path: Path, pairs: Tensor | None = None) -> list[tuple[int, int]]:
    """The pairs of a folder: those that it holds, or these, which are kept from now on.

    Args:
        path: The file.
        pairs: ``[M, 2]``, used where there is no file.

    Raises:
        ValueError: If the file holds something else.
    """
    if pairs is not None and not path.exists():
        write_json(path, pairs.tolist())
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        return [(int(first), int(second)) for first, second in found]
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path} is damaged ({error}); move the folder away") from error


def export(store: LabelStore, folder: Path) -> int:
    """Write ``preferences`` ``[M]``, which ``data.load`` reads, and ``raters.json``, about people.

    Attention checks, and answers that were taken back, are left out. Written beside and renamed.

    Args:
        store: Answers.
        folder: Where; the segments are in it already.

    Returns:
        Number of answers; with none nothing is written.
    """
    given = store.given()
    checks = store.attention_checks()
    people = store.database.all("SELECT id, name, code, began FROM rater ORDER BY id")
    write_json(
        folder / "raters.json",
        [
            {
                "rater": number - 1,
                "name": name,
                "code": code,
                "began": began,
                "checks_passed": checks.get(number, (0, 0))[0],
                "checks": checks.get(number, (0, 0))[1],
            }
            for number, name, code, began in people
        ],
    )
    if not given:
        return 0
    data = TensorDict(
        {
            PAIR: torch.tensor([[one.first, one.second] for one in given]),
            ANSWER: torch.tensor([one.answer for one in given]),
            RATER: torch.tensor([one.rater - 1 for one in given]),
        },
        [len(given)],
    )
    target = folder / "preferences"
    aside = Path(tempfile.mkdtemp(prefix=".preferences.", dir=folder))
    try:
        manifest = read_manifest(folder / "segments")
        about = {} if manifest is None else {"segments": manifest["digest"]}
        save_tensordict(data, aside / "new", about=about)
        if target.exists():
            target.rename(aside / "old")
        (aside / "new").rename(target)
    finally:
        shutil.rmtree(aside, ignore_errors=True)
    return len(given)
