"""Steps of a run that learns from real people, as ``popl-train`` and ``popl-people`` take them."""

import shutil
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import pandas as pd

from popl_rl.accessories import accessory
from popl_rl.algorithms.cpl import train
from popl_rl.algorithms.problem import Method
from popl_rl.algorithms.trainer import MethodTrainer
from popl_rl.config import Config
from popl_rl.data.readers.opening import open_data
from popl_rl.data.readers.summary import summarise
from popl_rl.data.readers.writing import read_folder, write_folder
from popl_rl.evaluation.people_statistics import PERSON_COLUMNS, summarise_people
from popl_rl.experiments.kept_tables import kept_table
from popl_rl.experiments.loggers import RunLogger
from popl_rl.experiments.metrics import MetricsWriter
from popl_rl.experiments.people import Fold, People, people_of, split
from popl_rl.experiments.people_report import people_alarm, write_people_report
from popl_rl.experiments.people_training import Trained, fit_ties, judge_fold, train_on
from popl_rl.experiments.progress import Progress
from popl_rl.experiments.run_manifest import check_own_data, run_id
from popl_rl.models.hypothesis_set import HypothesisSet
from popl_rl.storage import write_atomic

__all__ = [
    "REFERENCES",
    "compare_methods",
    "evolve_people",
    "finish_people",
    "make_folds",
    "read_people",
]

#: What every method is compared with.
REFERENCES = ("pooled_cpl", "individual")


def read_people(config: Config, run_dir: Path) -> People:
    """Read people's answers, or what the run has kept of them, and prepare them.

    Args:
        config: Settings of the run.
        run_dir: Folder of the run.

    Raises:
        ValueError: If the data make no sense, or not enough people can be held out.
    """
    kept = run_dir / "data"
    if kept.is_dir():
        check_own_data(run_dir)
        data = read_folder(kept)
    else:
        with Progress("rows", total=None) as progress:
            data = open_data(
                Path(str(config.data.load)),
                reader=config.data.reader,
                options=config.data.reader_options,
                progress=progress.update,
            )
    people = people_of(data, config.method)
    split(people, config.people, 0, ties=config.method.ties, seed=config.seed)  # before work starts
    if config.data.save and not kept.is_dir():
        write_folder(data, kept, about={"run": run_id(run_dir)})
    return people


def make_folds(config: Config, people: People, count: int) -> list[Fold]:
    """The first folds, with the thresholds of their ties where a model of draws explains these."""
    ties, seed = config.method.ties, config.seed
    folds = [split(people, config.people, number, ties=ties, seed=seed) for number in range(count)]
    return [fit_ties(people, fold, config) for fold in folds]


def evolve_people(
    config: Config, people: People, fold: Fold, run_dir: Path, logger: RunLogger
) -> Trained:
    """Train the run's own method, with checkpoints, and keep the set that it finds."""

    def run(method: Method) -> HypothesisSet:
        metrics = MetricsWriter(run_dir / "metrics.csv")
        with Progress("generations", total=method.generations) as progress:

            def on_generation(generation: int, values: dict[str, float]) -> None:
                metrics.write(generation, values)
                logger.log(values, generation)
                progress.update(generation, mean_accuracy=values["mean_accuracy"])

            trainer = MethodTrainer(
                method,
                generations=method.generations,
                checkpoint_dir=run_dir / "checkpoint",
                checkpoint_interval=config.checkpoint_interval,
                on_generation=on_generation,
                run=run_id(run_dir),
            )
            metrics.truncate_to(trainer.resume())
            trainer.train()
        return method.result()

    trained = train_on(people, fold, config, config.method.name, run=run)
    if trained.found is not None:
        trained.found.fair_member = trained.found.fair_among(people.bank, fold.training)
    return trained


def compare_methods(
    config: Config,
    people: People,
    *,
    methods: Sequence[str],
    folds: Sequence[Fold],
    cells: Path,
    known: Callable[[str, int], Trained | None] = lambda _name, _fold: None,
) -> pd.DataFrame:
    """Train methods on folds and judge them by the people who are held out of each.

    What has been done is read from ``cells``, so that a killed comparison goes on; the sets are
    there too.

    Args:
        config: Settings of the run.
        people: Everybody.
        methods: Names of the methods.
        folds: Whom to learn from and who judges.
        cells: Folder for a table of each method and fold.
        known: A method that was trained on a fold already.

    Returns:
        Rows of all people, see `popl_rl.evaluation.people_statistics.PERSON_COLUMNS`.
    """
    cells.mkdir(parents=True, exist_ok=True)
    tables = []
    done = 0
    with Progress("methods and folds", total=len(methods) * len(folds)) as progress:
        for fold in folds:
            for name in methods:
                path = cells / f"{name}-{fold.number}"
                make = partial(_judged, config, people, fold, name, path, known)
                text = {"choice": "str", "person": "str", "group": "str"}
                number = {"accuracy": float, "log_likelihood": float}
                file = path.with_suffix(".csv")
                tables.append(kept_table(file, make, dtype=text | number, keep_default_na=False))
                done += 1
                progress.update(done)
    return pd.concat(tables)[PERSON_COLUMNS]


def _judged(
    config: Config,
    people: People,
    fold: Fold,
    name: str,
    path: Path,
    known: Callable[[str, int], Trained | None],
) -> pd.DataFrame:
    """How a method that learns from a fold is judged; its set is saved in ``path``."""
    trained = known(name, fold.number) or train_on(people, fold, config, name, run=train)
    if trained.found is not None:
        shutil.rmtree(path, ignore_errors=True)
        trained.found.save(path)
    return judge_fold(people, fold, trained, config.people, seed=config.seed)


def finish_people(
    config: Config,
    people: People,
    folds: Sequence[Fold],
    table: pd.DataFrame,
    run_dir: Path,
    *,
    title: str,
) -> pd.DataFrame:
    """Write ``people.csv``, ``results.csv``, the report and, if any, the figure; give results."""
    write_atomic(run_dir / "people.csv", table.to_csv(index=False))
    references = [("pooled_cpl", ""), ("individual", ""), ("popl", "single")]
    results = summarise_people(table, references=references, seed=config.seed)
    write_atomic(run_dir / "results.csv", results.to_csv(index=False))
    about = {
        "people": f"{int(people.known.sum())} known by an id, of whom "
        f"{table['person'].nunique()} were held out once",
        "answers": f"{len(people.answers)} strict",
        "seed": config.seed,
    }
    if any(fold.training.tied is not None for fold in folds):
        about["tie threshold"] = ", ".join(f"{fold.training.threshold:.3g}" for fold in folds)
    warning = people_alarm(results, config.method.name)
    if warning is not None:
        about["alarm"] = warning
    report = partial(
        write_people_report,
        run_dir / "report.md",
        results,
        title=title,
        about=about,
        summary=summarise(people.data).lines(),
    )
    report(figures=[])
    if config.evaluation.figures:
        with accessory("there is no picture of the results", "the report has all numbers"):
            report(figures=[_draw_people(results, run_dir)])
    return results


def _draw_people(results: pd.DataFrame, run_dir: Path) -> Path:
    """Draw the curves over answers, and tell where, from the run's folder."""
    from popl_rl.plotting.people_plots import people_curves  # matplotlib only where it draws
    from popl_rl.plotting.style import save

    path = Path("figures", "people.png")
    (run_dir / path.parent).mkdir(exist_ok=True)
    save(people_curves(results), run_dir / path)
    return path
