"""Settings of methods: how hypotheses are learnt. A section says which methods it concerns."""

from dataclasses import dataclass, field
from typing import Any

from popl_rl.config.checks import Checker, parse_epsilon

__all__ = [
    "SECTIONS",
    "CloneSettings",
    "EMSettings",
    "KMeansSettings",
    "LoReSettings",
    "MethodConfig",
    "MixtureSettings",
    "NicheSettings",
    "POPLSettings",
    "RefinementSettings",
    "Training",
    "VPLSettings",
]


@dataclass
class Training:
    """The recipe by which all are trained: every method, the oracle and pooled CPL."""

    alpha: float = 0.25  # scale of the scores (CPL's temperature); smaller makes sharper policies
    conservatism: float = 0.8  # lambda of the CPL loss, in (0, 1]; 1 for reward functions
    bc: float = 0.0  # answers that behaviour cloning weighs, for policies; 0 for none
    slip: float = 0.05  # chance of a slip that the likelihood of an answer reckons with
    discount: float = 1.0  # per-step discount of the scores
    learning_rate: float = 2e-3  # of Adam; held for half of the generations, then falls to zero
    batch_size: int = 256  # preferences per CPL step and hypothesis
    steps: int = 1500  # CPL steps of a hypothesis in all, divided among the generations

    def check(self, at: Checker) -> None:
        """Report values that are out of range."""
        at.positive(self, "alpha", most=1000)
        at.positive(self, "learning_rate", most=10)
        at.share(self, "conservatism", "discount")
        at.not_negative(self, "bc", most=10**4)
        at.at_least_one(self, "batch_size", "steps")
        at.expect(0 <= self.slip < 0.5, "slip", "in [0, 0.5)", self.slip)


@dataclass
class POPLSettings:
    """Selection and variation of POPL."""

    selection: str = "lexicase"  # of parents: lexicase or a reference of kind selection
    tournament: int = 4  # members in a tournament (selection=tournament)
    epsilon: str | None = "mad"  # tolerance of lexicase: mad, a number, or null for none
    variation: str = "auto"  # gradient, gaussian (published), mixtures; auto goes by the cases
    rater_similarity: bool = True  # children learn from raters like the one they are for (ids)
    specialist_steps: int = 30  # CPL steps of the specialist for each rater (rater_similarity)
    pooled_steps: int = 200  # CPL steps on all answers: features=pooled, or before specialists
    warm_up: int = 20  # CPL steps on all answers before the first generation (no similarity)
    features: str = (
        "random"  # trunk of heads: random (published), or pooled: trained on all answers
    )
    mutation_std: float = 0.1  # standard deviation of a mutation (gaussian)

    def check(self, at: Checker) -> None:
        """Report values that are out of range."""
        at.at_least_one(self, "tournament", "specialist_steps", "pooled_steps")
        at.one_of(self, "variation", ("auto", "gradient", "gaussian", "mixtures"))
        at.one_of(self, "features", ("random", "pooled"))
        at.not_negative(self, "warm_up")
        at.positive(self, "mutation_std", most=1000)
        at.expect(bool(self.selection), "selection", "lexicase or a reference", self.selection)
        try:
            parse_epsilon(self.epsilon)
        except ValueError as error:
            at.problems.append(str(error))


@dataclass
class RefinementSettings:
    """POPL's last training: which members to keep, each trained on the raters whom it serves."""

    steps: int = 1500  # CPL steps; 0 for none (policies, gradient variation, rater ids)
    folds: int = 4  # folds of the cross-fitting
    most: int = 8  # members to begin with, at most
    rewards: bool = False  # refine reward functions too

    def check(self, at: Checker) -> None:
        """Report values that are out of range."""
        at.not_negative(self, "steps")
        at.at_least_one(self, "most")
        at.expect(self.folds >= 2, "folds", "at least 2", self.folds)
        at.not_negative(self, "folds", most=1000)


@dataclass
class NicheSettings:
    """POPL for any number of groups: searches for niches, and how many of these there are."""

    searches: int = 3  # searches side by side; each rater is held out of one of them
    specialists: int = 256  # raters, at most, for each of whom a specialist may be a founder
    selections: int = 6  # times in a search that unneeded members make room for children
    settled: float = 0.55  # generations of the searches, in those that the fresh members have
    trial_steps: int = 600  # CPL steps of a number's trial, at most those of the final training
    evidence: float = 0.0  # standard errors by which fewer niches may predict raters worse

    def check(self, at: Checker) -> None:
        """Report values that are out of range."""
        at.at_least_one(self, "specialists", "selections", "trial_steps")
        at.expect(self.searches >= 2, "searches", "at least 2", self.searches)
        at.expect(0 < self.settled < 1, "settled", "in (0, 1)", self.settled)
        at.not_negative(self, "evidence")


@dataclass
class MixtureSettings:
    """POPL without rater ids: lexicase selection among mixtures of policies."""

    mixtures: int = 24  # mixtures in the population
    generations: int = 24  # generations, with selection from the 14th on
    steps: int = 60  # CPL steps of a generation
    block: int = 15  # CPL steps from one E-step to the next
    held_out: float = 0.2  # share of the preferences that only selection sees
    bundle: int = 20  # held-out preferences of a lexicase case
    first_selection: int = 14  # generation after which selection begins
    alpha: float = 0.5  # scale of the scores until the final training, which has the recipe's
    conservatism: float = 0.9  # lambda of the CPL loss until then
    slip: float = 0.0  # chance of a slip: of one answer it cannot be told from another group's wish
    exchange: float = 0.15  # chance that a further child swaps a member with another mixture
    removal: float = 0.15  # chance that a further child loses a member
    final_steps: int = 1000  # CPL steps of the final, cross-fitted training
    final_batch_size: int = 1000  # preferences per step of it, the same for all members
    folds: int = 4  # folds of it

    def check(self, at: Checker) -> None:
        """Report values that are out of range."""
        names = ("mixtures", "generations", "steps", "block", "bundle", "first_selection")
        at.at_least_one(self, *names, "final_steps", "final_batch_size")
        at.expect(self.folds >= 2, "folds", "at least 2", self.folds)
        at.not_negative(self, "folds", most=1000)
        at.positive(self, "alpha", most=1000)
        at.share(self, "conservatism")
        at.expect(0 <= self.slip < 0.5, "slip", "in [0, 0.5)", self.slip)
        for name in ("held_out", "exchange", "removal"):
            value = getattr(self, name)
            at.expect(0 <= value < 1, name, "in [0, 1)", value)


@dataclass
class CloneSettings:
    """The behaviour-cloned network that style codes are fed to (``method.evolve=code``)."""

    code_dim: int = 2  # numbers in a style code
    steps: int = 3000  # gradient steps of behaviour cloning
    beta: float = 1e-3  # weight of the codes' divergence from their prior

    def check(self, at: Checker) -> None:
        """Report values that are out of range."""
        at.at_least_one(self, "code_dim", most=1000)
        at.at_least_one(self, "steps")
        at.not_negative(self, "beta")


@dataclass
class EMSettings:
    """EM mixtures, which are told the number of groups."""

    groups: int | None = None  # that number; null: as many as there are rater groups

    def check(self, at: Checker) -> None:
        """Report values that are out of range."""
        if self.groups is not None:
            at.at_least_one(self, "groups", most=10**4)


@dataclass
class VPLSettings:
    """Variational preference learning."""

    latent: int = 8  # numbers that say what a rater wants
    kl: float = 0.1  # weight of their divergence from N(0, 1)
    swap: float = 0.0  # weight of SPL's guidance: who said the opposite wants the opposite
    answers: int = 16  # answers of each rater in a batch

    def check(self, at: Checker) -> None:
        """Report values that are out of range."""
        at.at_least_one(self, "latent", most=10**4)
        at.at_least_one(self, "answers")
        at.not_negative(self, "kl", "swap")


@dataclass
class LoReSettings:
    """Low-rank reward functions: bases that all raters share, and each rater's weights of them."""

    bases: int = 8  # of which a rater's hypothesis is a mixture
    learning_rate: float = 0.1  # of Adam, for the raters' weights; bases have the recipe's
    fit_steps: int = 100  # in which the weights of a new rater are fitted

    def check(self, at: Checker) -> None:
        """Report values that are out of range."""
        at.at_least_one(self, "bases", most=10**4)
        at.at_least_one(self, "fit_steps")
        at.positive(self, "learning_rate", most=10)


@dataclass
class KMeansSettings:
    """k-means of raters by how well specialists for some of them explain each."""

    groups: int | None = None  # clusters; null: as many as there are rater groups
    silhouette: bool = False  # whether the silhouette chooses how many, up to ``most``
    most: int = 40  # clusters, at most, that the silhouette chooses among

    def check(self, at: Checker) -> None:
        """Report values that are out of range."""
        if self.groups is not None:
            at.at_least_one(self, "groups", most=10**4)
        at.expect(self.most >= 2, "most", "at least 2", self.most)
        at.not_negative(self, "most", most=10**4)
        told = self.groups is not None and self.silhouette
        at.expect(not told, "groups", "null where the silhouette chooses", self.groups)


_POPL = "popl_rl.algorithms.assembly:build_popl"

#: Sections of ``method`` by name: what ``method.reads`` may list.
SECTIONS = {
    "training": Training,
    "popl": POPLSettings,
    "refinement": RefinementSettings,
    "niches": NicheSettings,
    "mixture": MixtureSettings,
    "clone": CloneSettings,
    "em": EMSettings,
    "vpl": VPLSettings,
    "lore": LoReSettings,
    "kmeans": KMeansSettings,
}


@dataclass
class MethodConfig:
    """How hypotheses are learnt: the method, what it evolves, and a section for each part."""

    name: str = "popl"  # what its rows are called in results.csv
    factory: str = _POPL  # reference of kind method
    # Sections that the method is built from; settings of others are refused. null: those of POPL
    # for its own factory, and training alone for any other.
    reads: list[str] | None = None
    needs_ids: bool = False  # whether the method lives on rater ids
    learns: str = "auto"  # policy, reward; auto: reward where there is nothing to do but judge
    cases: str = "rater"  # what lexicase filters on: rater (needs rater ids) or preference
    # Ties and soft labels: drop; count by halves; rao_kupper: by halves but for ties, which a model
    # of draws explains. The last two need rater ids.
    ties: str = "drop"
    tie_threshold: float | None = None  # of rao_kupper, in units of margins; null: fitted
    evolve: str = "all"  # all: whole networks; head: last layers on a shared, frozen trunk; code:
    # style codes fed to a network that was cloned from the data's behaviour and is frozen
    hidden: list[int] = field(default_factory=lambda: [64, 64])  # units of each hidden layer
    # Outputs of the convolutions before these, where observations are images; null: 16 and 32 for
    # whole policy networks, none for others; [] for none.
    channels: list[int] | None = None
    members: int = 32  # hypotheses in the population; em: as many mixtures as fit
    generations: int = 100  # in which the steps of the training are divided
    training: Training = field(default_factory=Training)
    popl: POPLSettings = field(default_factory=POPLSettings)
    refinement: RefinementSettings = field(default_factory=RefinementSettings)
    niches: NicheSettings = field(default_factory=NicheSettings)
    mixture: MixtureSettings = field(default_factory=MixtureSettings)
    clone: CloneSettings = field(default_factory=CloneSettings)
    em: EMSettings = field(default_factory=EMSettings)
    vpl: VPLSettings = field(default_factory=VPLSettings)
    lore: LoReSettings = field(default_factory=LoReSettings)
    kmeans: KMeansSettings = field(default_factory=KMeansSettings)
    options: dict[str, Any] = field(default_factory=dict)  # further arguments of the factory

    def sections(self) -> list[str]:
        """Sections that the method is built from."""
        if self.reads is not None:
            return list(self.reads)
        if self.factory == _POPL:
            return ["training", "popl", "refinement", "mixture"]
        return ["training"]

    def convolutions(self) -> list[int]:
        """Outputs of each convolution, where observations are images."""
        if self.channels is None:
            return [16, 32] if self._can_convolve() else []
        return list(self.channels)

    def _can_convolve(self) -> bool:
        # Style codes, and what VPL believes of a rater, are fed to a network beside observations.
        return self.evolve != "code" and "vpl" not in self.sections() and bool(self.hidden)

    def check(self, at: Checker) -> None:
        """Report values that are out of range, or do not go together."""
        at.expect(bool(self.name), "name", "a name", self.name)
        at.expect(bool(self.factory), "factory", "a reference of a method", self.factory)
        unknown = [name for name in self.sections() if name not in SECTIONS]
        at.expect(not unknown, "reads", f"sections out of {', '.join(SECTIONS)}", unknown)
        at.one_of(self, "learns", ("auto", "policy", "reward"))
        at.expect(self.cases in ("rater", "preference"), "cases", "rater or preference", self.cases)
        at.one_of(self, "ties", ("drop", "count", "rao_kupper"))
        if self.tie_threshold is not None:
            at.positive(self, "tie_threshold", most=20)
            cure = "null but for method.ties=rao_kupper"
            at.expect(self.ties == "rao_kupper", "tie_threshold", cure, self.tie_threshold)
        at.one_of(self, "evolve", ("all", "head", "code"))
        at.at_least_one(self, "members", most=10**6)
        at.at_least_one(self, "generations")
        at.expect(all(units >= 1 for units in self.hidden), "hidden", "positive", self.hidden)
        small = len(self.hidden) <= 100 and all(units <= 10**5 for units in self.hidden)
        at.expect(small, "hidden", "at most 100 layers of at most 1e+05 units", self.hidden)
        few = [units for units in self.channels or [] if not 1 <= units <= 10**4]
        at.expect(
            not few and len(self.channels or []) <= 10,
            "channels",
            "at most 10 from 1 to 1e+04",
            few,
        )
        cure = "none for style codes, for VPL, and without hidden layers"
        at.expect(not self.channels or self._can_convolve(), "channels", cure, self.channels)
        for name in SECTIONS:
            getattr(self, name).check(at.below(name))
        self._check_together(at)

    def _check_together(self, at: Checker) -> None:
        cure = "rater, because it reads what one rater said"
        at.expect(self.cases == "rater" or not self.needs_ids, "cases", cure, self.cases)
        if self.evolve == "code":
            at.expect(self.learns != "reward", "learns", "policy for style codes", self.learns)
        if "popl" not in self.sections():
            return
        at.expect(self.members >= 2, "members", "at least 2, to select among", self.members)
        if self.popl.variation == "gaussian":
            at.expect(self.evolve == "head", "evolve", "head for Gaussian variation", self.evolve)
        mixtures = self.popl.variation == "mixtures"
        if mixtures or (self.cases == "preference" and self.popl.variation == "auto"):
            at.expect(self.evolve != "code", "evolve", "all without rater ids", self.evolve)
