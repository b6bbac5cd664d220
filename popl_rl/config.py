"""Schemas of the configuration, with defaults and what they mean, and one check of it all."""

from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from omegaconf import MISSING

__all__ = [
    "ALGORITHMS",
    "Config",
    "DataConfig",
    "EnvConfig",
    "EvaluateConfig",
    "EvaluationConfig",
    "LoggerConfig",
    "MethodConfig",
    "RatersConfig",
    "ResponseConfig",
    "validate",
]


#: What ``method.algorithm`` may be, and what its rows are called in ``results.csv``; ``cpl`` are
#: there the rows of the baseline.
ALGORITHMS = {
    "popl": "popl",
    "cpl": "multi_cpl",
    "multi_cpl": "multi_cpl",
    "em": "em",
    "vpl": "vpl",
}

_SELECTIONS = ("lexicase", "tournament", "best_sum", "random", "nsga2")


@dataclass
class EnvConfig:
    """Which environment, and how long an episode may be."""

    factory: str = "two_doors"  # registered name, module:attr or file.py:attr
    options: dict[str, Any] = field(default_factory=dict)  # arguments of the factory
    data_options: dict[str, Any] = field(default_factory=dict)  # on top of these, for data only
    mixture: dict[str, float] | None = None  # share of behaviours in the data, by name or pattern
    id: str | None = None  # id of a Gymnasium environment, for env=gym
    max_steps: int = 60  # steps after which an episode is cut
    success: str = "goal"  # number in info that is positive when the task is done
    door: str | None = None  # integer in info whose values are worth a row in the table
    measured: list[str] = field(default_factory=list)  # numbers in info whose mean and peak are


@dataclass
class ResponseConfig:
    """How raters answer: B-Pref's model (Lee et al., 2021), the same for all groups."""

    rationality: float = float("inf")  # beta of the Bernoulli answer; inf always tells the truth
    mistake: float = 0.0  # chance that an answer is flipped
    myopia: float = 1.0  # gamma; below 1 the end of a segment weighs more
    tie: float = 0.0  # differences up to this are ties
    skip: float | None = None  # pairs in which both are worth no more than this are skipped


@dataclass
class RatersConfig:
    """Who is asked, and what they want."""

    groups: list[str] = field(default_factory=list)  # references of rater functions
    shares: list[float] | None = None  # chance of each group; equal if null
    count: int = 200  # raters
    answers: int = 20  # answers of each
    label: str = "regret"  # what raters compare by: regret or return
    response: ResponseConfig = field(default_factory=ResponseConfig)


@dataclass
class DataConfig:
    """The segments that raters see."""

    segments: int = 4000  # segments to collect
    length: int = 12  # steps of a segment
    memmap: str | None = None  # folder for memory-mapped storage; in memory if null
    load: str | None = None  # folder 'data' of an earlier run: its segments and preferences
    save: bool = True  # keep segments and preferences in the run folder
    store: str | None = None  # folder in which segments are kept for other runs; none if null
    seed: int | None = None  # of the segments; that of the run if null


@dataclass
class MethodConfig:
    """How the policies are learnt."""

    name: str = "popl"
    algorithm: str = "popl"  # popl; to compare with: cpl (pooled), multi_cpl, em, vpl
    selection: str = "lexicase"  # of parents: lexicase, tournament, best_sum, random, nsga2 (popl)
    tournament: int = 4  # members in a tournament (selection=tournament)
    groups: int = 2  # groups that the mixture is told there are (em)
    latent: int = 8  # numbers that say what a rater wants (vpl)
    kl: float = 0.1  # weight of their divergence from N(0, 1) (vpl)
    learns: str = "auto"  # policy, reward; auto: reward where there is nothing to do but judge
    cases: str = "rater"  # what lexicase filters on: rater (needs rater ids) or preference
    variation: str = "auto"  # gradient, gaussian (published), teams; auto goes by the cases
    evolve: str = "all"  # all: whole networks; head: last layers on a shared, frozen trunk; code:
    # style codes fed to a network that was cloned from the data's behaviour and is frozen
    code_dim: int = 2  # numbers in a style code (code)
    clone_steps: int = 3000  # gradient steps of behaviour cloning (code)
    clone_beta: float = 1e-3  # weight of the codes' divergence from their prior (code)
    features: str = "random"  # that trunk: random (published), or pooled: trained on all answers
    members: int = 32  # policies in the population; em: as many mixtures as fit, the best is kept
    generations: int = 100  # others than popl: blocks of method.steps CPL steps
    hidden: list[int] = field(default_factory=lambda: [64, 64])  # units of each hidden layer
    epsilon: str | None = "mad"  # tolerance of lexicase: mad, a number, or null for none
    alpha: float = 0.5  # scale of the scores (CPL's temperature)
    conservatism: float = 0.9  # lambda of the CPL loss, in (0, 1]; 1 for reward functions
    discount: float = 1.0  # per-step discount of the scores
    warm_up: int = 20  # CPL steps on all answers before the first generation (without kinship)
    kinship: bool = True  # children learn from raters akin to whom they are for (gradient, ids)
    pooled_steps: int = 200  # CPL steps on all answers: features=pooled, or before specialists
    specialist_steps: int = 30  # CPL steps of the specialist for each rater (kinship)
    steps: int = 15  # CPL steps of each child (gradient)
    batch_size: int = 256  # preferences per CPL step and member (gradient)
    learning_rate: float = 2e-3  # of Adam (gradient)
    polish_steps: int = 1500  # CPL steps of the last training; 0 for none (policies, gradient, ids)
    polish_alpha: float = 0.25  # scale of the scores in it
    polish_conservatism: float = 0.8  # lambda of the CPL loss in it
    teams: int = 24  # teams of policies in the population (teams)
    team_generations: int = 24  # generations of 60 CPL steps (teams)
    mutation_std: float = 0.1  # standard deviation of a mutation (gaussian)


@dataclass
class EvaluationConfig:
    """How the result is judged."""

    episodes: int = 200  # episodes per policy
    new_raters: int = 20  # new raters of each group that the set is catered to
    answers: int = 20  # answers of each of them
    # Numbers of answers that catering is measured at besides, on the same new raters; [] for none.
    curve: list[int] = field(default_factory=lambda: [1, 2, 5, 10, 20, 50])
    curve_members: int = 40  # members that are rolled out for these curves at most
    pairs: int = 4000  # fresh pairs per group for accuracies
    menu: int = 10  # items that a reward function chooses from, where there is nothing to do
    optimiser: str = "auto"  # how reward functions act: plan, ppo; auto: plan if there is a table
    ppo_frames: int = 100_000  # frames of PPO for each of them
    greedy: bool = False  # most likely actions instead of sampled ones
    reference: str = "random"  # whose return is a recovery of 0: random; clone: of the data's
    # typical behaviour; others: the oracle of whichever other group suits a group least
    baselines: bool = True  # train pooled CPL and the oracle too
    baselines_from: str | None = None  # folder 'baselines' of a run on the same data; not trained
    reward_baselines: bool = True  # B-REX and DPL too, where items are judged
    brex_steps: int = 10_000  # steps of B-REX's chain
    dpl_steps: int = 500  # steps of DPL's training
    baseline_steps: int = 1500  # CPL steps of these
    baseline_batch_size: int = 256  # preferences per step of these
    baseline_learning_rate: float = 2e-3  # of their Adam
    baseline_alpha: float = 0.5  # scale of their scores
    baseline_conservatism: float = 0.9  # lambda of their CPL loss; 1 for reward functions
    animate: bool = False  # an animated GIF for each group, where there is a renderer
    history: int = 10  # generations between two snapshots for the pictures; 0 for none


@dataclass
class LoggerConfig:
    """Where metrics go besides metrics.csv."""

    name: str = "wandb"  # wandb (offline) or csv (nothing more)
    project: str = "popl_rl"


@dataclass
class EvaluateConfig:
    """What popl-evaluate does with a finished run."""

    run_dir: str = MISSING  # folder of the run
    # What differs from the run's own settings: MISSING, which merging passes over, is as the run.
    evaluation: EvaluationConfig = field(
        default_factory=lambda: EvaluationConfig(
            **dict.fromkeys((setting.name for setting in fields(EvaluationConfig)), MISSING)
        )
    )
    # Of the held-out pairs, new raters and episodes. The run's seed + 1 if null, which gives other
    # ones than the run's; the run's seed gives its own.
    seed: int | None = None


@dataclass
class Config:
    """A whole run."""

    env: EnvConfig = field(default_factory=EnvConfig)
    raters: RatersConfig = field(default_factory=RatersConfig)
    data: DataConfig = field(default_factory=DataConfig)
    method: MethodConfig = field(default_factory=MethodConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    logger: LoggerConfig = field(default_factory=LoggerConfig)
    seed: int = 0
    device: str = "cpu"  # where policies are trained: cpu or cuda
    threads: int = 1  # torch threads; on small networks more is slower
    run_dir: str | None = None  # folder of the run; runs/<time>-<method>-<seed> if null
    resume: str | None = None  # folder of a killed run to finish
    checkpoint_interval: int = 10  # generations between checkpoints


def validate(config: Config) -> None:
    """Check values that can be checked before anything is built.

    Raises:
        ValueError: Listing every problem at once, each with what was expected and what came.
    """
    problems: list[str] = []

    def expect(condition: bool, name: str, expected: str, value: object) -> None:
        if not condition:
            problems.append(f"{name} must be {expected}, got {value!r}")

    def at_least_one(section: object, prefix: str, *names: str) -> None:
        for name in names:
            value = getattr(section, name)
            expect(value >= 1, f"{prefix}.{name}", "at least 1", value)

    raters, data, method, evaluation = (
        config.raters,
        config.data,
        config.method,
        config.evaluation,
    )
    at_least_one(config.env, "env", "max_steps")
    reference = "a reference, such as env.factory=my_env.py:make"
    expect(bool(config.env.factory), "env.factory", reference, config.env.factory)
    if config.env.factory == "gymnasium:make":
        name = "the id of a Gymnasium environment, such as env.id=CartPole-v1"
        expect(bool(config.env.id), "env.id", name, config.env.id)
    mixture = config.env.mixture
    if mixture is not None:
        proper = all(share >= 0 for share in mixture.values())
        proper = proper and abs(sum(mixture.values()) - 1) < 1e-6
        expect(proper, "env.mixture", "non-negative shares that sum to 1", dict(mixture))
    at_least_one(raters, "raters", "count", "answers")
    at_least_one(data, "data", "segments", "length")
    at_least_one(evaluation, "evaluation", "episodes", "new_raters", "answers", "pairs")
    at_least_one(evaluation, "evaluation", "curve_members")
    positive = all(answers >= 1 for answers in evaluation.curve)
    expect(positive, "evaluation.curve", "numbers of at least 1", list(evaluation.curve))
    at_least_one(evaluation, "evaluation", "baseline_steps", "baseline_batch_size")
    at_least_one(method, "method", "generations", "steps", "batch_size")
    at_least_one(method, "method", "teams", "team_generations", "pooled_steps")
    at_least_one(method, "method", "specialist_steps", "code_dim", "clone_steps")
    at_least_one(method, "method", "tournament", "groups", "latent")
    expect(method.kl >= 0, "method.kl", "at least 0", method.kl)
    at_least_one(evaluation, "evaluation", "ppo_frames", "brex_steps", "dpl_steps")
    expect(evaluation.menu >= 2, "evaluation.menu", "at least 2, to choose", evaluation.menu)
    for name, value, known in (
        ("evaluation.optimiser", evaluation.optimiser, ("auto", "plan", "ppo")),
        ("evaluation.reference", evaluation.reference, ("random", "clone", "others")),
        ("method.algorithm", method.algorithm, tuple(ALGORITHMS)),
        ("method.selection", method.selection, _SELECTIONS),
        ("method.learns", method.learns, ("auto", "policy", "reward")),
        ("method.features", method.features, ("random", "pooled")),
    ):
        expect(value in known, name, ", ".join(known), value)
    expect(data.segments >= 2, "data.segments", "at least 2, to compare", data.segments)
    expect(bool(raters.groups), "raters.groups", "one or more rater references", raters.groups)
    repeated = len(set(raters.groups)) < len(raters.groups)
    expect(not repeated, "raters.groups", "different groups", raters.groups)
    if raters.shares is not None:
        fits = len(raters.shares) == len(raters.groups)
        expected = f"one number per group ({len(raters.groups)})"
        expect(fits, "raters.shares", expected, raters.shares)
        proper = all(share >= 0 for share in raters.shares) and abs(sum(raters.shares) - 1) < 1e-6
        expect(proper, "raters.shares", "non-negative and sum to 1", raters.shares)
    expect(raters.label in ("regret", "return"), "raters.label", "regret or return", raters.label)
    response = raters.response
    expect(
        response.rationality > 0, "raters.response.rationality", "positive", response.rationality
    )
    expect(0 <= response.mistake <= 1, "raters.response.mistake", "in [0, 1]", response.mistake)
    expect(0 < response.myopia <= 1, "raters.response.myopia", "in (0, 1]", response.myopia)
    expect(response.tie >= 0, "raters.response.tie", "at least 0", response.tie)
    expect(
        method.cases in ("rater", "preference"), "method.cases", "rater or preference", method.cases
    )
    kinds = ("auto", "gradient", "gaussian", "teams")
    expect(method.variation in kinds, "method.variation", ", ".join(kinds), method.variation)
    evolved = ("all", "head", "code")
    expect(method.evolve in evolved, "method.evolve", ", ".join(evolved), method.evolve)
    if method.evolve == "code":
        expect(method.learns != "reward", "method.learns", "policy for style codes", method.learns)
        whole = method.algorithm == "vpl" or method.variation == "teams"
        whole = whole or (method.algorithm == "popl" and method.cases == "preference")
        expect(not whole, "method.evolve", "all for VPL, and without rater ids", method.evolve)
    expect(method.clone_beta >= 0, "method.clone_beta", "at least 0", method.clone_beta)
    if method.variation == "gaussian":
        expect(
            method.evolve == "head", "method.evolve", "head for Gaussian variation", method.evolve
        )
    expect(method.members >= 2, "method.members", "at least 2, to select among", method.members)
    expect(all(units >= 1 for units in method.hidden), "method.hidden", "positive", method.hidden)
    expect(method.alpha > 0, "method.alpha", "positive", method.alpha)
    for name in ("conservatism", "polish_conservatism"):
        value = getattr(method, name)
        expect(0 < value <= 1, f"method.{name}", "in (0, 1]", value)
    steps = method.polish_steps
    expect(steps >= 0, "method.polish_steps", "at least 0", steps)
    expect(method.polish_alpha > 0, "method.polish_alpha", "positive", method.polish_alpha)
    expect(0 < method.discount <= 1, "method.discount", "in (0, 1]", method.discount)
    expect(method.warm_up >= 0, "method.warm_up", "at least 0", method.warm_up)
    expect(method.learning_rate > 0, "method.learning_rate", "positive", method.learning_rate)
    expect(method.mutation_std > 0, "method.mutation_std", "positive", method.mutation_std)
    try:
        parse_epsilon(method.epsilon)
    except ValueError as error:
        problems.append(str(error))
    expect(evaluation.history >= 0, "evaluation.history", "at least 0", evaluation.history)
    for name in ("baseline_learning_rate", "baseline_alpha"):
        value = getattr(evaluation, name)
        expect(value > 0, f"evaluation.{name}", "positive", value)
    conservatism = evaluation.baseline_conservatism
    proper = 0 < conservatism <= 1
    expect(proper, "evaluation.baseline_conservatism", "in (0, 1]", conservatism)
    proper = config.device.split(":")[0] in ("cpu", "cuda")
    expect(proper, "device", "cpu or cuda", config.device)
    names = ("wandb", "csv")
    expect(config.logger.name in names, "logger.name", "wandb or csv", config.logger.name)
    expect(config.threads >= 1, "threads", "at least 1", config.threads)
    expect(
        config.checkpoint_interval >= 1,
        "checkpoint_interval",
        "at least 1",
        config.checkpoint_interval,
    )
    if evaluation.baselines_from is not None:
        found = Path(evaluation.baselines_from).is_dir()
        expected = "the folder 'baselines' of an earlier run"
        expect(found, "evaluation.baselines_from", expected, evaluation.baselines_from)
    if data.load is not None:
        found = (Path(data.load) / "segments").is_dir()
        expect(found, "data.load", "the folder 'data' of an earlier run", data.load)
    if problems:
        raise ValueError("the configuration has problems:\n  " + "\n  ".join(problems))


def parse_epsilon(epsilon: str | float | None) -> float | str | None:
    """Read ``method.epsilon``: ``"mad"``, a non-negative number, or None.

    Raises:
        ValueError: If it is something else.
    """
    if epsilon is None or epsilon == "mad":
        return epsilon
    try:
        value = float(epsilon)
    except ValueError:
        value = -1.0
    if not value >= 0:
        raise ValueError(
            f"method.epsilon must be mad, a number of at least 0, or null, got {epsilon!r}"
        )
    return value
