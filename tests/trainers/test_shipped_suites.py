"""Every cell of every suite that is shipped has settings that are valid."""

from importlib.resources import files

import pytest

from popl_rl.experiments.cells import plan
from popl_rl.experiments.suites import load_suite
from popl_rl.trainers.benchmark_cells import make_tasks

SUITES = files("popl_rl.configs.suites")
NAMES = sorted(path.name.removesuffix(".yaml") for path in SUITES.iterdir() if ".yaml" in path.name)


@pytest.mark.slow  # half a minute for all
@pytest.mark.parametrize("name", NAMES)
def test_its_cells_can_be_run(name, tmp_path):
    cells = plan(load_suite(name, folder=SUITES), seeds=1)
    assert len(make_tasks(cells, tmp_path)) == len(cells)
