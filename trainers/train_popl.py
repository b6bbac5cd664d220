"""Train a policy set with POPL, from nothing to a report: ``popl-train``.

Collects behaviour, asks simulated raters, evolves a population of policies by lexicase selection,
and shows what the set is worth to every hidden group beside pooled CPL and the oracle.

    popl-train                                   # two doors, two hidden groups
    popl-train raters=three_groups env.options.doors=3
    popl-train method.cases=preference           # without rater ids
    popl-train -m seed=0,1,2                     # a sweep
    popl-train resume=runs/<name>                # finish a killed run
"""

import shutil
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import hydra
import torch
from omegaconf import OmegaConf
from rich.console import Console

from popl_rl.algorithms.reward_baselines import train_reward_baselines
from popl_rl.algorithms.trainer import POPLTrainer
from popl_rl.config import Config, validate
from popl_rl.data.comparisons import Comparisons
from popl_rl.data.environments import build_world, indexed, is_stateless
from popl_rl.evaluation.diagnostics import alarm, diagnostics
from popl_rl.evaluation.results import Scoreboard
from popl_rl.experiments.builders import (
    build_bank,
    build_clone,
    build_groups,
    build_popl,
    build_spec,
    final_set,
    generations_of,
    label_of,
    make_data,
    stream,
    train_baselines,
    typical,
)
from popl_rl.experiments.evaluators import make_evaluator
from popl_rl.experiments.loggers import make_logger
from popl_rl.experiments.metrics import MetricsWriter
from popl_rl.experiments.report import markdown, results_table
from popl_rl.experiments.run_folder import (
    Progress,
    create_run_dir,
    load_config,
    save_config,
    write_metadata,
)
from popl_rl.models.hypothesis_set import HypothesisSet
from popl_rl.models.reward_functions import RewardSpec
from popl_rl.models.sets import as_set
from popl_rl.models.style_codes import StyleClone
from popl_rl.plotting.run_figures import draw
from popl_rl.storage import write_atomic
from popl_rl.trainers.command import register_schemas, run_command


@dataclass(frozen=True)
class Result:
    """What a run leaves behind."""

    run_dir: Path
    policies: HypothesisSet
    board: Scoreboard


def run(config: Config) -> Result:
    """Run everything a configuration describes."""
    # 1. The run folder, and what is to be done.
    if config.resume is not None:
        run_dir = create_run_dir(Path(config.resume), name="", resume=True)
        stored: Any = OmegaConf.merge(OmegaConf.structured(Config), load_config(run_dir))
        config = stored
        validate(config)
    else:
        validate(config)
        name = f"{config.method.name}-seed{config.seed}"
        wanted = None if config.run_dir is None else Path(config.run_dir)
        run_dir = create_run_dir(wanted, name=name)
        save_config(run_dir, config)
    write_metadata(run_dir, command=sys.argv)
    torch.set_num_threads(config.threads)
    settings: Any = OmegaConf.to_container(OmegaConf.structured(config), resolve=True)

    # 2. World, raters, and what they say.
    world = build_world(config.env)
    groups = build_groups(config.raters, world)
    kept = run_dir / "data"
    load = kept if (kept / "preferences").is_dir() else None
    if load is None and config.data.load is not None:
        load = Path(config.data.load)
    with Progress("segments", total=config.data.segments) as progress:
        data = make_data(
            config.data,
            config.raters,
            world,
            groups,
            seed=config.seed,
            env=config.env,
            load=load,
            progress=progress.update,
        )
    if config.data.save:
        data.save(kept)
    spec = build_spec(config.method, world.env)
    bank = build_bank(indexed(data.steps, world.env.action_space), spec).to(config.device)
    comparisons = Comparisons.from_preferences(data.preferences, cases=config.method.cases)
    comparisons = comparisons.to(config.device)
    clone: StyleClone | None = None
    cloned = None
    if config.method.evolve == "code" or config.evaluation.reference == "clone":
        with Progress("cloning", total=config.method.clone_steps) as progress:
            clone = build_clone(
                config.method,
                spec,
                bank,
                seed=config.seed,
                path=run_dir if data.store is None else data.store.parent,
                progress=progress.update,
            )
    if clone is not None:
        cloned = as_set(typical(clone), alpha=config.method.alpha)
        _save_anew(cloned, run_dir / "clone")
    if config.method.evolve != "code":
        clone = None

    # 3. The population, evolved.
    learner = stream(config.seed, "learner", config.device)
    popl = build_popl(config.method, spec, bank, comparisons, clone=clone, generator=learner)
    evaluator = make_evaluator(config, world, groups, data, spec, clone=cloned, seed=config.seed)
    metrics = MetricsWriter(run_dir / "metrics.csv")
    history = MetricsWriter(run_dir / "history.csv")
    generations = generations_of(config.method)
    logger_name: Any = config.logger.name
    with (
        make_logger(logger_name, run_dir, project=config.logger.project, config=settings) as logger,
        Progress("generations", total=generations) as progress,
    ):

        def on_generation(generation: int, values: dict[str, float]) -> None:
            metrics.write(generation, values)
            logger.log(values, generation)
            worst = values["worst_rater_accuracy"]
            progress.update(generation, worst_rater_accuracy=worst)
            every = config.evaluation.history
            if every and (generation % every == 0 or generation in (1, generations)):
                now = as_set(popl.population, alpha=popl.alpha, discount=popl.discount)
                history.write(generation, evaluator.snapshot(now))

        trainer = POPLTrainer(
            popl,
            generations=generations,
            checkpoint_dir=run_dir / "checkpoint",
            checkpoint_interval=config.checkpoint_interval,
            on_generation=on_generation,
        )
        done = trainer.resume()
        metrics.truncate_to(done)
        history.truncate_to(done)
        trainer.train()
        found = final_set(popl)
        _save_anew(found, run_dir / found.folder)

        # 4. What the set is compared with, on the same data.
        baselines = None
        if config.evaluation.baselines:
            with Progress("baselines", total=config.evaluation.baseline_steps) as baseline_bar:
                baselines = train_baselines(
                    config.evaluation,
                    spec,
                    bank,
                    comparisons,
                    data.preferences,
                    num_groups=len(groups),
                    clone=clone,
                    generator=stream(config.seed, "baselines", config.device),
                    progress=baseline_bar.update,
                )
            _save_anew(baselines, run_dir / "baselines")
        reward_baselines = None
        if config.evaluation.reward_baselines and is_stateless(world.env):
            reward_baselines = train_reward_baselines(
                cast("RewardSpec", spec),
                bank,
                comparisons,
                brex_steps=config.evaluation.brex_steps,
                dpl_steps=config.evaluation.dpl_steps,
                generator=stream(config.seed, "rivals", config.device),
            )

        # 5. Judged by every hidden group; told in a table, in pictures and in words.
        label = label_of(config.method)
        board = evaluator.score(found, baselines, reward_baselines=reward_baselines, label=label)
        write_atomic(run_dir / "results.csv", board.results.to_csv(index=False))
        figures = draw(
            run_dir,
            found,
            baselines,
            board=board,
            evaluator=evaluator,
            world=world,
            reward_baselines=reward_baselines,
        )
        logger.log_figures(figures, generations)
        logger.log_table("results", board.results)
    about = {
        f"{found.folder} in the set": f"{len(found)}, effectively "
        f"{found.effective_number(bank, comparisons):.1f}",
        "comparisons": f"{len(comparisons)} strict, {comparisons.num_dropped} ties and skips",
        "cases": f"{comparisons.num_cases} ({config.method.cases}s)",
        "seed": config.seed,
        **diagnostics(board, evaluator),
    }
    text = markdown(
        board.results,
        title=f"{'POPL: ' if label == 'popl' else ''}{config.method.name} in {config.env.factory}",
        about=about,
        figures=[Path("figures") / path.name for path in figures.values()],
    )
    write_atomic(run_dir / "report.md", text)
    return Result(run_dir, found, board)


def _save_anew(found: HypothesisSet, path: Path) -> None:
    """Save a set in the place of what a killed run may have left."""
    shutil.rmtree(path, ignore_errors=True)
    found.save(path)


def show(result: Result) -> None:
    """Print the table and where everything is."""
    console = Console()
    console.print(results_table(result.board.results))
    warning = alarm(result.board.results)
    if warning is not None:
        console.print(f"alarm: {warning}", style="bold red", highlight=False, soft_wrap=True)
    console.print(f"report, pictures, policies and logs: {result.run_dir}", soft_wrap=True)


register_schemas()


@hydra.main(version_base="1.3", config_path="pkg://popl_rl.configs", config_name="train")
def main(cfg: Any) -> None:
    """Hydra's entry."""
    show(run(cfg))


def cli() -> None:
    """Console command ``popl-train``."""
    run_command(main)


if __name__ == "__main__":
    cli()
