"""What the sets in the cells of a benchmark guarantee, as tidy rows."""

from pathlib import Path

import pandas as pd
from omegaconf import OmegaConf

from popl_rl.config import Config, plain
from popl_rl.data.comparisons import Comparisons
from popl_rl.data.environments import indexed
from popl_rl.evaluation.guarantees import guarantees
from popl_rl.experiments.builders import build_spec
from popl_rl.experiments.cells import COLUMNS
from popl_rl.experiments.reevaluation import gather_again
from popl_rl.experiments.run_manifest import load_run_config
from popl_rl.experiments.run_sets import load_found_set, load_own_set
from popl_rl.manifest import read_json

__all__ = ["guarantee_rows"]


def guarantee_rows(benchmark: Path) -> pd.DataFrame:
    """Count undominated members in all finished cells of a benchmark.

    Args:
        benchmark: Its folder; cells must learn from rater ids, and have oracles.

    Returns:
        Rows ``suite, scenario, seed, method, choice, group, measure, value`` of the measures of
        ``popl_rl.evaluation.guarantees.guarantees``, and ``population``, the members that each
        method trained.

    Raises:
        FileNotFoundError: If there is no finished cell.
        ValueError: If what a cell has kept is damaged or lacks rater ids.
    """
    cells = sorted(path.parent for path in benchmark.glob("cells/*/*/seed*/results.csv"))
    if not cells:
        raise FileNotFoundError(
            f"{benchmark} has no finished cells; run popl-benchmark with run_dir={benchmark} first"
        )
    suite = read_json(benchmark / "benchmark.json", cure="give the folder of a benchmark")["suite"]
    rows = []
    for cell in cells:
        scenario, method, seed = cell.parts[-3:]
        key = (suite, scenario, int(seed.removeprefix("seed")), method, "", "all")
        rows += [(*key, measure, value) for measure, value in _measures(cell).items()]
    return pd.DataFrame(rows, columns=COLUMNS)


def _measures(run_dir: Path) -> dict[str, float]:
    """What the set of one run guarantees."""
    config: Config = plain(OmegaConf.merge(OmegaConf.structured(Config), load_run_config(run_dir)))
    if config.method.cases != "rater":
        raise ValueError(
            f"{run_dir} was trained with cases={config.method.cases!r}, expected 'rater': who is "
            "served at least as well is told over raters; run it with method.cases=rater"
        )
    found, baselines = load_found_set(run_dir), load_own_set(run_dir, "baselines")
    # As the run evaluated: its own fresh segments and held-out pairs.
    world, data, evaluator = gather_again(config, run_dir, seed=config.seed)
    spec = build_spec(config.method, world.env)
    measured = guarantees(
        found,
        baselines.subset(list(range(1, len(baselines)))),  # the first is for everybody
        evaluator,
        bank=spec.bank(indexed(data.steps, world.env.action_space)),
        training=Comparisons.from_preferences(data.preferences, cases="rater"),
    )
    return {"population": float(config.method.members), **measured}
