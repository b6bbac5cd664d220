from pathlib import Path

import pytest

from popl_rl.experiments.costs import Cost
from popl_rl.trainers import benchmark_plan
from popl_rl.trainers.run_benchmark import BenchmarkConfig, foretell

SUITE = """
methods:
  popl: []
  other: [method=popl_published]
scenarios:
  plain: []
"""


def test_a_plan_tells_what_it_costs_and_runs_nothing(monkeypatch, tmp_path, capsys):
    """Two kinds of cells, 3 seeds each, of half an hour to an hour, on two workers."""
    monkeypatch.chdir(tmp_path)
    Path("mine.yaml").write_text(SUITE)
    asked = []

    def calibrate(config):
        asked.append((config.method.name, config.seed))
        return Cost((1800.0, 3600.0), 2.0**30, 2.0**31)

    monkeypatch.setattr(benchmark_plan, "calibrate", calibrate)
    plan = foretell(BenchmarkConfig(suite="mine.yaml", seeds=3, run_dir="out"))
    assert asked == [("popl", 0), ("popl_published", 0)], "once for each kind"
    assert not Path("out").exists()
    assert plan.hours == pytest.approx((3, 6))
    assert plan.disk == 6 * 2**30
    assert plan.memory == 2 * 2**31
    benchmark_plan.show_plan(plan)
    told = capsys.readouterr().out
    assert "6 cells to run: 3.0 to 6.0 hours of a core, 1.5 to 3.0 hours with workers=2" in told
    assert "6.0 GiB will be written" in told
    assert "4.0 GiB of memory for all workers" in told
