"""The steps of a training run, in the order in which ``trainers/train_popl.py`` takes them."""

from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

from popl_rl.algorithms.problem import Method, Problem
from popl_rl.algorithms.reward_baselines import RewardBaselines, train_reward_baselines
from popl_rl.algorithms.tie_threshold import with_threshold
from popl_rl.algorithms.trainer import MethodTrainer
from popl_rl.config import Config
from popl_rl.data.comparisons import Comparisons
from popl_rl.data.environments import World, indexed, is_stateless
from popl_rl.evaluation.diagnostics import diagnostics
from popl_rl.evaluation.evaluator import Evaluator
from popl_rl.evaluation.results import Scoreboard
from popl_rl.experiments.behaviours import ppo_raters
from popl_rl.experiments.builders import (
    build_clone,
    build_method,
    build_problem,
    build_spec,
    check_answers,
    train_baselines,
)
from popl_rl.experiments.data import Data, given_data, make_data
from popl_rl.experiments.evaluators import make_evaluator
from popl_rl.experiments.foresight import Foresight, last_training
from popl_rl.experiments.loggers import RunLogger, make_logger
from popl_rl.experiments.metrics import MetricsWriter, write_sizes
from popl_rl.experiments.ppo_policies import ppo_policies, tell_cost
from popl_rl.experiments.preflight import Place, check_infos
from popl_rl.experiments.progress import Progress
from popl_rl.experiments.report import markdown
from popl_rl.experiments.run_manifest import check_own_data, run_id
from popl_rl.experiments.run_sets import save_anew
from popl_rl.experiments.run_start import kept_unless_refused, open_run
from popl_rl.keys import INFO
from popl_rl.models.hypothesis_set import HypothesisSet
from popl_rl.models.policy_set import PolicySet
from popl_rl.models.reward_functions import RewardSpec
from popl_rl.models.sets import as_set
from popl_rl.models.style_population import StyledPopulation
from popl_rl.randomness import stream
from popl_rl.raters.groups import RaterGroup
from popl_rl.storage import write_atomic

__all__ = [
    "References",
    "Setting",
    "build",
    "describe",
    "draw",
    "evaluate",
    "evolve",
    "gather",
    "kept_unless_refused",
    "log_results",
    "open_logger",
    "open_run",
    "train_references",
    "write_report",
]


@dataclass(frozen=True)
class Setting:
    """Where a run takes place, what raters said there, and who evaluates.

    Attributes:
        world: Environment.
        groups: G hidden groups; the learner gets none of them.
        data: Segments and preferences.
        problem: What methods are given.
        evaluator: Evaluates sets for every group.
    """

    world: World
    groups: tuple[RaterGroup, ...]
    data: Data
    problem: Problem
    evaluator: Evaluator


@dataclass(frozen=True)
class References:
    """What a set is compared with, trained on the same data by the same recipe.

    Attributes:
        baselines: Pooled CPL, then the oracle of each group; None if they were not asked for.
        rewards: B-REX and DPL, where items are judged.
        ppo: A policy for each group that PPO has trained on its utility, if it was asked for.
    """

    baselines: HypothesisSet | None
    rewards: RewardBaselines | None
    ppo: PolicySet | None = None


def gather(config: Config, run_dir: Path, place: Place) -> Setting:
    """Collect segments and ask the raters, or load what an earlier run collected."""
    world, groups = place.world, place.groups
    kept = run_dir / "data"
    has_kept = (kept / "preferences").is_dir()
    load, reader = (kept, None) if has_kept else given_data(config.data)
    wanted = config.raters.groups if config.evaluation.ppo_reference else []
    tell_cost(config.env, [*wanted, *(ppo_raters(config.env) if load is None else [])], world.make)
    if has_kept:
        check_own_data(run_dir)
    with Progress("segments", total=config.data.segments) as progress:
        data = make_data(
            config.data,
            config.raters,
            world,
            groups,
            seed=config.seed,
            env=config.env,
            load=load,
            reader=reader,
            progress=progress.update,
        )
    if load is None and world.collect is None:
        check_infos(config.env, map(str, data.steps[INFO].keys()))
    if config.data.save:
        data.save(kept, about={"run": run_id(run_dir)})
    spec = build_spec(config.method, world.env)
    bank = spec.bank(indexed(data.steps, world.env.action_space)).to(config.device)
    comparisons = Comparisons.from_preferences(
        data.preferences,
        cases=config.method.cases,
        ties=config.method.ties,  # type: ignore[arg-type]
    )
    names = [group.name for group in groups]
    check_answers(config.evaluation, comparisons, data.preferences, names)
    clone, typical = None, None
    if config.method.evolve == "code" or config.evaluation.reference == "clone":
        with Progress("cloning", total=config.method.clone.steps) as progress:
            clone = build_clone(
                config.method,
                spec,
                bank,
                seed=config.seed,
                path=run_dir if data.store is None else data.store.parent,
                progress=progress.update,
            )
        alone = StyledPopulation(clone, clone.typical().unsqueeze(0))
        typical = as_set(alone, alpha=config.method.training.alpha)
        save_anew(typical, run_dir / "clone", run_dir, digests=data.digests)
    comparisons = comparisons.to(config.device)
    problem = build_problem(config.method, spec, bank, comparisons, clone=clone)
    problem = with_threshold(
        problem,
        threshold=config.method.tie_threshold,
        generator=stream(config.seed, "tie threshold", config.device),
    )
    evaluator = make_evaluator(config, world, groups, data, spec, clone=typical, seed=config.seed)
    return Setting(world, groups, data, problem, evaluator)


def open_logger(config: Config, run_dir: Path) -> AbstractContextManager[RunLogger]:
    """Where the run reports to while it goes on."""
    name: Any = config.logger.name
    return make_logger(name, run_dir, project=config.logger.project, config=asdict(config))


def build(config: Config, setting: Setting) -> Method:
    """The method, with a population to start from."""
    generator = stream(config.seed, "learner", config.device)
    groups = len(setting.groups)
    return build_method(config.method, setting.problem, num_groups=groups, generator=generator)


def evolve(
    config: Config, setting: Setting, method: Method, run_dir: Path, logger: RunLogger
) -> HypothesisSet:
    """Run the generations that are still to come, and keep the set that they find."""
    metrics = MetricsWriter(run_dir / "metrics.csv")
    history = MetricsWriter(run_dir / "history.csv")
    every, last = config.evaluation.history, method.generations
    with Progress("generations", total=last) as progress:
        foresight = Foresight(config, method, groups=len(setting.groups))

        def on_generation(generation: int, values: dict[str, float]) -> None:
            foresight(generation)
            metrics.write(generation, values)
            logger.log(values, generation)
            progress.update(generation, worst_rater_accuracy=values["worst_rater_accuracy"])
            if every and (generation % every == 0 or generation in (1, last)):
                now = setting.problem.hypothesis_set(method.population)
                history.write(generation, setting.evaluator.snapshot(now))

        trainer = MethodTrainer(
            method,
            generations=last,
            checkpoint_dir=run_dir / "checkpoint",
            checkpoint_interval=config.checkpoint_interval,
            on_generation=on_generation,
            run=run_id(run_dir),
        )
        done = trainer.resume()
        metrics.truncate_to(done)
        history.truncate_to(done)
        trainer.train()
    with Progress("last training", total=last_training(config.method, method)) as progress:
        if hasattr(method, "progress"):
            method.progress = progress.update
        found = method.result()
    found.fair_member = found.fair_among(setting.problem.bank, setting.problem.comparisons)
    save_anew(found, run_dir / found.folder, run_dir, digests=setting.data.digests)
    write_sizes(method, run_dir / "sizes.csv")
    return found


def train_references(config: Config, setting: Setting, run_dir: Path) -> References:
    """Pooled CPL, the oracles, PPO and, where items are judged, B-REX and DPL."""
    options, problem = config.evaluation, setting.problem
    baselines, rewards = None, None
    if options.baselines:
        with Progress("baselines", total=problem.generations) as progress:
            baselines = train_baselines(
                options,
                problem,
                setting.data.preferences,
                num_groups=len(setting.groups),
                digests=setting.data.digests,
                generator=stream(config.seed, "baselines", config.device),
                progress=progress.update,
            )
        save_anew(baselines, run_dir / "baselines", run_dir, digests=setting.data.digests)
    if options.reward_baselines and is_stateless(setting.world.env):
        rewards = train_reward_baselines(
            cast("RewardSpec", problem.spec),
            problem.bank,
            problem.comparisons,
            brex_steps=options.brex_steps,
            dpl_steps=options.dpl_steps,
            generator=stream(config.seed, "rivals", config.device),
        )
    ppo = None
    if options.ppo_reference:
        ppo = ppo_policies(config.env, config.raters.groups, setting.world.make)
    return References(baselines, rewards, ppo)


def evaluate(
    config: Config,
    setting: Setting,
    found: HypothesisSet,
    references: References,
    run_dir: Path,
) -> Scoreboard:
    """What the set is worth to every group; writes ``results.csv``."""
    with Progress("evaluation", total=None):
        board = setting.evaluator.score(
            found,
            references.baselines,
            reward_baselines=references.rewards,
            ppo=references.ppo,
            label=config.method.name,
        )
    write_atomic(run_dir / "results.csv", board.results.to_csv(index=False))
    return board


def draw(
    config: Config,
    setting: Setting,
    found: HypothesisSet,
    references: References,
    board: Scoreboard,
    run_dir: Path,
) -> dict[str, Path]:
    """Every picture that the run has the data for; none with ``evaluation.figures=false``."""
    if not config.evaluation.figures:
        return {}
    from popl_rl.plotting import run_figures  # matplotlib only where figures are drawn

    return run_figures.draw(
        run_dir,
        found,
        references.baselines,
        board=board,
        evaluator=setting.evaluator,
        world=setting.world,
        reward_baselines=references.rewards,
        with_animations=config.evaluation.animate,
    )


def log_results(
    logger: RunLogger, board: Scoreboard, figures: dict[str, Path], generation: int
) -> None:
    """Hand table and figures to the logger."""
    logger.log_figures(figures, generation)
    logger.log_table("results", board.results)


def describe(
    config: Config, setting: Setting, found: HypothesisSet, board: Scoreboard
) -> dict[str, object]:
    """What the report says besides the results, by name."""
    problem = setting.problem
    comparisons, method = problem.comparisons, config.method
    effective = found.effective_number(problem.bank, comparisons)
    kind = "strict"
    if comparisons.answer is not None:
        kind = f"that say {int(comparisons.answer.max()) + 1} answers"
    left_out = f"{comparisons.num_dropped} ties and skips left out"
    ties = {} if comparisons.tied is None else {"tie threshold": f"{comparisons.threshold:.3g}"}
    return {
        f"{found.folder} in the set": f"{len(found)}, effectively {effective:.1f}",
        "comparisons": f"{len(comparisons)} {kind}, {left_out}",
        "cases": f"{comparisons.num_cases} ({method.cases}s)",
        **ties,
        "recipe": ", ".join(f"{name} {value:g}" for name, value in vars(method.training).items()),
        "seed": config.seed,
        **diagnostics(board, setting.evaluator),
    }


def write_report(
    config: Config,
    board: Scoreboard,
    about: dict[str, object],
    figures: dict[str, Path],
    run_dir: Path,
) -> None:
    """Write ``report.md``, with the figures that there are so far."""
    method = config.method
    title = f"{'POPL: ' if method.name == 'popl' else ''}{method.name} in {config.env.factory}"
    text = markdown(
        board.results,
        title=title,
        about=about,
        figures=[Path("figures") / path.name for path in figures.values()],
        label=board.label,
    )
    write_atomic(run_dir / "report.md", text)
