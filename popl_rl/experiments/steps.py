"""The steps of a training run, in the order in which ``trainers/train_popl.py`` takes them."""

import logging
import shutil
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import torch
from omegaconf import OmegaConf

from popl_rl.algorithms.problem import Method, Problem
from popl_rl.algorithms.reward_baselines import RewardBaselines, train_reward_baselines
from popl_rl.algorithms.trainer import MethodTrainer
from popl_rl.config import Config, changed, load_config, plain, validate
from popl_rl.data.comparisons import Comparisons
from popl_rl.data.environments import World, indexed, is_stateless
from popl_rl.evaluation.diagnostics import diagnostics
from popl_rl.evaluation.evaluator import Evaluator
from popl_rl.evaluation.results import Scoreboard
from popl_rl.experiments.builders import (
    build_clone,
    build_method,
    build_problem,
    build_spec,
    train_baselines,
)
from popl_rl.experiments.data import Data, given_data, make_data
from popl_rl.experiments.evaluators import make_evaluator
from popl_rl.experiments.foresight import Foresight, last_training
from popl_rl.experiments.loggers import RunLogger, make_logger
from popl_rl.experiments.metrics import MetricsWriter, write_sizes
from popl_rl.experiments.preflight import Place, check_infos, survey
from popl_rl.experiments.progress import Progress
from popl_rl.experiments.report import markdown
from popl_rl.experiments.run_folder import (
    create_run_dir,
    save_config,
    write_metadata,
)
from popl_rl.keys import INFO
from popl_rl.models.hypothesis_set import HypothesisSet
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
    "save_anew",
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
    """

    baselines: HypothesisSet | None
    rewards: RewardBaselines | None


def open_run(
    config: Config, *, command: Sequence[str], given: Sequence[str] = ()
) -> tuple[Config, Path, Place | None]:
    """Make the folder of a run, or find the one to continue with its own settings.

    Args:
        config: Settings that were checked; of a run that is continued, where it is.
        command: What was typed, for ``metadata.json``.
        given: Overrides that were typed; of those beside ``resume=`` a run that is continued takes
            the ones that ``popl_rl.config.CHANGEABLE`` allows.

    Returns:
        The settings, the folder, and where the run takes place; no place where people's answers are
        learnt from without simulated raters.

    Raises:
        ValueError: If the settings of the run that is continued are off, or something that they
            name cannot be found or does not go together.
        OSError: If the folder exists already, or there is no run to resume.
    """
    is_new = config.resume is None
    if config.resume is not None:
        run_dir = create_run_dir(Path(config.resume), name="", resume=True)
        stored: Any = OmegaConf.merge(OmegaConf.structured(Config), load_config(run_dir))
        asked = OmegaConf.structured(config)
        for name in changed(given):
            OmegaConf.update(stored, name, OmegaConf.select(asked, name))
        config = plain(stored)
        validate(config)
    logging.getLogger("torchrl").setLevel(logging.WARNING)  # TorchRL sets its own when imported
    torch.set_num_threads(config.threads)
    place = survey(config)
    if not is_new:
        write_metadata(run_dir, command=command)
        return config, run_dir, place

    def fill(folder: Path) -> None:
        save_config(folder, config)
        write_metadata(folder, command=command)

    name = f"{config.method.name}-seed{config.seed}"
    wanted = None if config.run_dir is None else Path(config.run_dir)
    return config, create_run_dir(wanted, name=name, fill=fill), place


@contextmanager
def kept_unless_refused(run_dir: Path, *, is_new: bool) -> Iterator[None]:
    """Remove a new run's folder if the block refuses what was asked for.

    So that nothing stands in the way of the corrected command. A full disk or a kill is no refusal.

    Args:
        run_dir: Folder of the run.
        is_new: Whether it began with this process; a run that is resumed keeps its folder.

    Raises:
        TypeError: What the block raises.
        ValueError: Likewise.
    """
    try:
        yield
    except (TypeError, ValueError):
        if is_new:
            shutil.rmtree(run_dir, ignore_errors=True)
        raise


def gather(config: Config, run_dir: Path, place: Place) -> Setting:
    """Collect segments and ask the raters, or load what an earlier run collected."""
    world, groups = place.world, place.groups
    kept = run_dir / "data"
    has_kept = (kept / "preferences").is_dir()
    load, reader = (kept, None) if has_kept else given_data(config.data)
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
        data.save(kept)
    spec = build_spec(config.method, world.env)
    bank = spec.bank(indexed(data.steps, world.env.action_space)).to(config.device)
    comparisons = Comparisons.from_preferences(
        data.preferences,
        cases=config.method.cases,
        ties=config.method.ties,  # type: ignore[arg-type]
    )
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
        save_anew(typical, run_dir / "clone")
    comparisons = comparisons.to(config.device)
    problem = build_problem(config.method, spec, bank, comparisons, clone=clone)
    evaluator = make_evaluator(config, world, groups, data, spec, clone=typical, seed=config.seed)
    return Setting(world, groups, data, problem, evaluator)


def open_logger(config: Config, run_dir: Path) -> AbstractContextManager[RunLogger]:
    """Where the run reports to while it goes on."""
    settings: Any = OmegaConf.to_container(OmegaConf.structured(config), resolve=True)
    name: Any = config.logger.name
    return make_logger(name, run_dir, project=config.logger.project, config=settings)


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
    save_anew(found, run_dir / found.folder)
    write_sizes(method, run_dir / "sizes.csv")
    return found


def train_references(config: Config, setting: Setting, run_dir: Path) -> References:
    """Pooled CPL, the oracles and, where items are judged, B-REX and DPL."""
    options, problem = config.evaluation, setting.problem
    baselines, rewards = None, None
    if options.baselines:
        with Progress("baselines", total=problem.generations) as progress:
            baselines = train_baselines(
                options,
                problem,
                setting.data.preferences,
                num_groups=len(setting.groups),
                generator=stream(config.seed, "baselines", config.device),
                progress=progress.update,
            )
        save_anew(baselines, run_dir / "baselines")
    if options.reward_baselines and is_stateless(setting.world.env):
        rewards = train_reward_baselines(
            cast("RewardSpec", problem.spec),
            problem.bank,
            problem.comparisons,
            brex_steps=options.brex_steps,
            dpl_steps=options.dpl_steps,
            generator=stream(config.seed, "rivals", config.device),
        )
    return References(baselines, rewards)


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
    """Every picture that the run has the data for."""
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
    return {
        f"{found.folder} in the set": f"{len(found)}, effectively {effective:.1f}",
        "comparisons": f"{len(comparisons)} strict, {comparisons.num_dropped} ties and skips",
        "cases": f"{comparisons.num_cases} ({method.cases}s)",
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


def save_anew(found: HypothesisSet, path: Path) -> None:
    """Save a set in the place of what a killed run may have left."""
    shutil.rmtree(path, ignore_errors=True)
    found.save(path)
