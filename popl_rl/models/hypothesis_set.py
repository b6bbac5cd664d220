"""The result of training: a set of hypotheses, and choosing from it for one person or for all."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, ClassVar, Literal, Self, cast

import torch
import torch.nn.functional as F  # noqa: N812 - the name everyone knows
from tensordict import TensorDictBase
from torch import Tensor

from popl_rl.data.bank import SegmentBank
from popl_rl.data.comparisons import Comparisons
from popl_rl.data.pairs import draw_pairs, starts_of
from popl_rl.keys import ANSWER, PAIR, Answer
from popl_rl.models.catered import Catered
from popl_rl.models.policies import PolicySpec
from popl_rl.models.population import Population
from popl_rl.models.preference_likelihood import MISTAKE, log_likelihood
from popl_rl.models.questions import (
    CANDIDATES,
    ENOUGH,
    RULES,
    Behaviours,
    Question,
    best_question,
)
from popl_rl.models.reward_functions import RewardSpec
from popl_rl.models.scoring import margins_of, pass_shares, segment_scores
from popl_rl.models.set_files import VERSION, read_about, read_population, write_set
from popl_rl.selection.lexicase import lexicase_selection

__all__ = ["Catered", "HypothesisSet"]


class HypothesisSet:
    """Hypotheses about what people want, of which every hidden group should find its own.

    Args:
        population: The hypotheses.
        alpha: Scale of their scores, as trained.
        discount: Per-step discount of their scores.

    Attributes:
        origin: Member of the trained population that each one is; empty if it is none of them.
        fair_member: The fair choice for the raters of the training, for people who have said
            nothing yet; None where nobody has made it.
        provenance: Of a set that was read: what ``save`` was told of the run that it is from.
    """

    folder: ClassVar[str]  #: of a run, in which it is kept
    _kind: ClassVar[str]
    _spec: ClassVar[type[PolicySpec] | type[RewardSpec]]

    def __init__(
        self, population: Population, *, alpha: float = 0.5, discount: float = 1.0
    ) -> None:
        self.population = population
        self.alpha = alpha
        self.discount = discount
        self.origin = list(range(len(population)))
        self.fair_member: int | None = None
        self.provenance: dict[str, str] = {}

    def distinct(self, bank: SegmentBank, comparisons: Comparisons) -> Self:
        """Keep one member for each distinct row of passes ``[M]``, the first with that row."""
        # Members are told apart by the comparisons so far, then by some more.
        number = torch.zeros(len(self), 1, dtype=torch.int32, device=self.population.device)
        for margin in self._margins_in_parts(bank, comparisons):
            seen = torch.cat([number, (margin > 0).int()], 1)
            number = torch.unique(seen, dim=0, return_inverse=True)[1].int().unsqueeze(1)
        inverse = number.flatten().tolist()
        return self.subset(sorted({inverse.index(behaviour) for behaviour in inverse}))

    def __len__(self) -> int:
        return len(self.population)

    def effective_number(self, bank: SegmentBank, comparisons: Comparisons) -> float:
        """How many clearly different hypotheses there are, between 1 and ``len(self)``.

        The similarity-sensitive diversity of order 2 (Leinster and Cobbold, 2012), ``1 / sum_ij
        p_i Z_ij p_j`` with equal shares p; two members are as similar as the agreement of their
        passes exceeds chance, ``Z = max(0, 2 agreement - 1)``.
        """
        together = torch.zeros(len(self), len(self), device=self.population.device)
        for margin in self._margins_in_parts(bank, comparisons):
            sign = (margin > 0).float() * 2 - 1
            together += sign @ sign.T
        similarity = (together / len(comparisons)).clamp(min=0)
        return float(1 / similarity.mean())

    @staticmethod
    def _bank(segments: TensorDictBase) -> SegmentBank:
        """Segments as hypotheses of this kind read them."""
        return SegmentBank.from_segments(segments)

    def margins(self, segments: TensorDictBase | SegmentBank, comparisons: Comparisons) -> Tensor:
        """Margins of every hypothesis on every comparison, ``[N, M]``; positive is a pass."""
        return margins_of(*self._scores(segments, comparisons))

    def _margins_in_parts(
        self, segments: TensorDictBase | SegmentBank, comparisons: Comparisons
    ) -> Iterator[Tensor]:
        """As ``margins``, some comparisons after the other, ``[N, B]``."""
        scores, comparisons = self._scores(segments, comparisons)
        for part in comparisons.answer_blocks(len(self)):
            yield margins_of(scores, comparisons, part)

    def _scores(
        self, segments: TensorDictBase | SegmentBank, comparisons: Comparisons
    ) -> tuple[Tensor, Comparisons]:
        """Scores of segments ``[N, segments]``, and the comparisons by their numbers in these."""
        bank = segments if isinstance(segments, SegmentBank) else self._bank(segments)
        pair = torch.stack([comparisons.preferred, comparisons.other])
        device = self.population.device
        how: dict[str, Any] = {"alpha": self.alpha, "discount": self.discount}
        if pair.numel() < len(bank):  # a few answers are about a few segments
            used, pair = pair.unique(return_inverse=True)
            bank = bank.subset(used)
            comparisons = replace(comparisons, preferred=pair[0], other=pair[1])
        how["wanted"] = comparisons.segments(len(bank))
        return segment_scores(self.population, bank.to(device), **how), comparisons.to(device)

    def cater(
        self,
        segments: TensorDictBase | SegmentBank,
        answers: TensorDictBase,
        *,
        method: Literal["posterior", "lexicase"] = "posterior",
        mistake: float = MISTAKE,
        scores: Tensor | None = None,
        generator: torch.Generator | None = None,
    ) -> Catered:
        """Choose a hypothesis for one rater from a few answers.

        Args:
            segments: What the answers are about.
            answers: TensorDict ``[K]`` with ``pair`` (rows of two of the segments) and ``answer``
                (a ``popl_rl.keys.Answer``: 0 where the first of the two is preferred, 1 where the
                second is); ties and skips are ignored. Without any answer the choice is the fair
                one of the raters of the training, ``fair_member``.
            method: ``"posterior"``: belief ``w_n ~ prod_k p(answer_k | Delta_nk)`` with ``p = (1 -
                mistake) sigmoid(Delta) + mistake sigmoid(-Delta)``, and the one believed in
                most. ``"lexicase"``: one lexicase selection over the answers, as in the POPL
                paper; needs ``generator``.
            mistake: Chance of a slip, which keeps single answers from ruling a policy out.
            scores: Of all segments in the eyes of all hypotheses, ``[N, segments]``, where somebody
                knows them, who asks for many people; worked out if None.
            generator: Source of the lexicase draw.

        Returns:
            The chosen member, and the belief in each, ``[N]``.

        Raises:
            ValueError: If answers are no such numbers or all ties and skips, there are none and
                ``fair_member`` is unknown, ``method`` is unknown, ``mistake`` is outside [0, 0.5)
                or ``generator`` is missing.
        """
        if not len(answers):
            return self._unasked()
        comparisons = Comparisons.from_preferences(answers, cases="preference")
        if scores is None:
            margin = self.margins(segments, comparisons).cpu()
        else:
            margin = margins_of(scores.cpu(), comparisons.to("cpu"))
        if method == "posterior":
            log_weight = log_likelihood(margin, mistake).sum(1)
            return Catered(int(log_weight.argmax()), log_weight.softmax(0))
        if method == "lexicase":
            if generator is None:
                raise ValueError("generator must be given for lexicase catering")
            member = int(lexicase_selection(margin > 0, 1, generator=generator))
            return Catered(member, F.one_hot(torch.tensor(member), len(self)).float())
        raise ValueError(f"method must be 'posterior' or 'lexicase', got {method!r}")

    def _unasked(self) -> Catered:
        """What somebody is given who has said nothing."""
        if self.fair_member is None:
            raise ValueError(
                "answers must hold at least one answer, since this set does not know its fair "
                "choice (fair_member is None); set it to fair(segments, preferences)"
            )
        return Catered(self.fair_member, torch.full((len(self),), 1 / len(self)))

    def next_question(
        self,
        segments: TensorDictBase | SegmentBank,
        answers: TensorDictBase | None = None,
        *,
        rule: str = "information_gain",
        pairs: Tensor | None = None,
        candidates: int = CANDIDATES,
        enough: float = ENOUGH,
        limit: int | None = None,
        mistake: float = MISTAKE,
        generator: torch.Generator | None = None,
    ) -> Question | None:
        """Choose what to ask one person next; see ``popl_rl.models.questions``.

        Args:
            segments: What may be asked about. Of a TensorDict with
                ``popl_rl.keys.START``, only segments from the same start are compared.
            answers: TensorDict ``[K]`` with ``pair`` and ``answer``, the person's so far; None or
                empty for none. Nothing is asked twice, ties and skips included.
            rule: ``"information_gain"``, ``"volume_removal"``, ``"expected_maximum"`` or
                ``"uniform"``.
            pairs: Candidates ``[P, 2]``; drawn uniformly if None.
            candidates: How many to draw.
            enough: Belief in one behaviour from which on nothing is asked; above 1 for never.
            limit: Most questions in all; None for no limit.
            mistake: Chance of a slip, as in ``cater``.
            generator: Source of the candidates, and of uniform choices.

        Returns:
            The question; None where enough is known, ``limit`` questions were asked, or no
            candidate is left.

        Raises:
            ValueError: If ``rule`` is unknown, ``pairs`` is empty or of another shape,
                ``candidates`` is not positive, or ``generator`` is needed and missing.
        """
        if rule not in (*RULES, "uniform"):
            raise ValueError(f"rule must be uniform, {', '.join(RULES)}, got {rule!r}")
        asked = torch.empty(0, 2, dtype=torch.long) if answers is None else answers[PAIR].cpu()
        if limit is not None and len(asked) >= limit:
            return None
        if pairs is None:
            if candidates < 1:
                raise ValueError(f"candidates must be at least 1, got {candidates}")
            if generator is None:
                raise ValueError("generator must be given to draw candidates; or pass pairs")
            start = None if isinstance(segments, SegmentBank) else starts_of(segments)
            pairs = draw_pairs(len(segments), candidates, start=start, generator=generator)
        elif pairs.ndim != 2 or pairs.shape[1] != 2 or not len(pairs):
            raise ValueError(f"pairs must have shape [P, 2] with P > 0, got {list(pairs.shape)}")
        everything = Comparisons(pairs[:, 0], pairs[:, 1], torch.arange(len(pairs)), len(pairs))
        margin = self.margins(segments, everything).cpu()
        behaviours = Behaviours(margin, mistake=mistake)
        weights = torch.full((len(self),), 1 / len(self))
        if answers is not None and bool((answers[ANSWER] <= Answer.SECOND).any()):
            weights = self.cater(segments, answers, mistake=mistake).weights
        same = (pairs.sort(-1).values.unsqueeze(1) == asked.sort(-1).values).all(-1).any(-1)
        if same.all() or float(behaviours.belief(weights).max()) >= enough:
            return None
        index, value = best_question(behaviours, weights, ~same, rule=rule, generator=generator)
        return Question(pairs[index], value, weights)

    def fair(
        self,
        segments: TensorDictBase | SegmentBank,
        answers: TensorDictBase,
        *,
        quantile: float = 0.1,
    ) -> int:
        """The one hypothesis that does best by the raters it serves worst.

        Args:
            segments: What the answers are about.
            answers: TensorDict ``[M]`` with ``pair``, ``answer`` and ``rater``.
            quantile: Quantile over raters of its accuracy that is maximised; 0.1 as in the
                POPL paper, 0 for the minimum.

        Returns:
            The chosen member.

        Raises:
            ValueError: If ``quantile`` is outside [0, 1] or no answer is strict.
        """
        if not 0 <= quantile <= 1:
            raise ValueError(f"quantile must be in [0, 1], got {quantile}")
        comparisons = Comparisons.from_preferences(answers, cases="rater")
        return self.fair_among(segments, comparisons, quantile=quantile)

    def fair_among(
        self,
        segments: TensorDictBase | SegmentBank,
        comparisons: Comparisons,
        *,
        quantile: float = 0.1,
    ) -> int:
        """As ``fair``, from comparisons; the most accurate one where nobody's are known by id."""
        scores, comparisons = self._scores(segments, comparisons)
        values = pass_shares(scores, comparisons).values.cpu()
        if comparisons.is_single:
            return int(values.mean(1).argmax())
        # One after the other: torch refuses the quantiles of more than 16 million values at once.
        return int(torch.stack([row.quantile(quantile) for row in values]).argmax())

    def save(self, path: Path | str, *, provenance: Mapping[str, str] | None = None) -> None:
        """Write the set as tensors and JSON; nothing is left half-written.

        Args:
            path: The folder to be.
            provenance: What is kept about the run that it is from, such as its id.

        Raises:
            FileExistsError: If ``path`` exists.
            OSError: If there is no room.
        """
        population = self.population.plain()
        trunk = {name: value.tolist() for name, value in population.trunk.state_dict().items()}
        about = {
            "format": f"popl_rl.{self._kind}_set/{VERSION}",
            "members": len(self),
            "spec": asdict(cast("PolicySpec | RewardSpec", population.spec)),
            "evolve": population.evolve,
            "alpha": self.alpha,
            "discount": self.discount,
            "origin": self.origin,
            "fair_member": self.fair_member,
            "trunk": trunk,
            "provenance": dict(provenance or {}),
        }
        write_set(Path(path), about, population.members.data, more=self._write_more)

    def _write_more(self, folder: Path) -> None:
        """Write what this kind of set keeps beside its members."""

    @classmethod
    def _assemble(
        cls,
        population: Population,
        path: Path,  # noqa: ARG003 - for kinds that keep more
        *,
        digest: str | None,  # noqa: ARG003 - of what they keep
        alpha: float,
        discount: float,
    ) -> Self:
        """A set of these members, with what ``_write_more`` wrote at ``path``."""
        return cls(population, alpha=alpha, discount=discount)

    @classmethod
    def is_at(cls, path: Path | str) -> bool:
        """Whether a set of this very kind was saved at ``path``."""
        return (Path(path) / f"{cls._kind}_set.json").is_file()

    @classmethod
    def load(cls, path: Path | str) -> Self:
        """Read what ``save`` wrote.

        Raises:
            FileNotFoundError: If there is no set of this kind at ``path``.
            ValueError: If it is truncated, damaged, or something else.
        """
        path = Path(path)
        about_path = path / f"{cls._kind}_set.json"
        if not about_path.is_file():
            others = [other.stem for other in path.glob("*_set.json")]
            cure = f"it holds {others[0]}.json: read it with load_set()" if others else ""
            raise FileNotFoundError(
                f"no {cls._kind} set at {path}: expected the folder {cls.folder!r} of a finished "
                f"run{'; ' * bool(cure)}{cure}"
            )
        try:
            about = read_about(about_path)
            population = read_population(path, about, cls._spec)
            scale = {name: float(about[name]) for name in ("alpha", "discount")}
            if not (0 < scale["alpha"] < math.inf and 0 < scale["discount"] <= 1):
                raise ValueError(f"alpha must be positive and discount in (0, 1], got {scale}")
            digest = about["digests"].get("encoder")
            loaded = cls._assemble(population, path, digest=digest, **scale)
            loaded.origin = [int(member) for member in about["origin"]]
            fair = about.get("fair_member")  # sets of earlier versions do not know it
            loaded.fair_member = None if fair is None else int(fair)
            loaded.provenance = dict(about.get("provenance", {}))
        except (
            AttributeError,
            FileNotFoundError,
            KeyError,
            RuntimeError,
            TypeError,
            ValueError,
        ) as error:
            raise ValueError(
                f"{path} is not readable as a {cls._kind} set ({error}); it is truncated or was "
                "written by something else; train again or restore the folder"
            ) from error
        return loaded

    def subset(self, members: Sequence[int]) -> Self:
        """Some of the hypotheses, in the given order."""
        chosen = type(self)(
            self.population.subset(members), alpha=self.alpha, discount=self.discount
        )
        self._tell(chosen, members)
        return chosen

    def _tell(self, chosen: "HypothesisSet", members: Sequence[int]) -> None:
        """Tell a set of some members of this one what this one knows of them."""
        chosen.origin = [self.origin[member] for member in members] if self.origin else []
        if self.fair_member is not None and self.fair_member in members:
            chosen.fair_member = list(members).index(self.fair_member)
