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
from popl_rl.experiments.data import build_groups, build_world, make_data
from popl_rl.experiments.evaluators import make_evaluator
from popl_rl.experiments.run_manifest import load_run_config
from popl_rl.experiments.run_sets import load_own_set
from popl_rl.manifest import read_json
from popl_rl.models.policy_set import PolicySet
from popl_rl.models.reward_set import RewardSet

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
    is_reward = (run_dir / RewardSet.folder).is_dir()
    found = load_own_set(run_dir, (RewardSet if is_reward else PolicySet).folder)
    baselines = load_own_set(run_dir, "baselines")
    world = build_world(config.env)
    groups = build_groups(config.raters, world)
    data = make_data(
        config.data,
        config.raters,
        world,
        groups,
        seed=config.seed,
        env=config.env,
        load=run_dir / "data" if (run_dir / "data").is_dir() else None,
    )
    spec = build_spec(config.method, world.env)
    # As the run evaluated: its own fresh segments and held-out pairs.
    evaluator = make_evaluator(config, world, groups, data, spec, seed=config.seed)
    measured = guarantees(
        found,
        baselines.subset(list(range(1, len(baselines)))),  # the first is for everybody
        evaluator,
        bank=spec.bank(indexed(data.steps, world.env.action_space)),
        training=Comparisons.from_preferences(data.preferences, cases="rater"),
    )
    return {"population": float(config.method.members), **measured}
