import pandas as pd
import pytest

from popl_rl.experiments.tables import COLUMNS
from popl_rl.trainers.make_tables import main


@pytest.fixture
def checkout(tmp_path):
    folder = tmp_path / "configs" / "results"
    folder.mkdir(parents=True)
    (folder / "tables.toml").write_text(
        '[t]\nsuite = "s"\nmeasure = "recovery"\nmethods = [["cpl", "", "pooled CPL"]]\n'
        'scenarios = {two = "two groups"}\n'
    )
    for page in (tmp_path / "README.md", tmp_path / "configs" / "README.md"):
        page.write_text("# Results\n<!-- table: t -->\n<!-- end -->\n")
    return tmp_path


def test_rows_are_taken_over_and_shown(checkout, tmp_path):
    benchmark = tmp_path / "benchmark"
    benchmark.mkdir()
    rows = [
        ("s", "two", 0, "cpl", "", "a", "recovery", 0.25),
        ("s", "two", 0, "cpl", "", "a", "return", 1.0),
    ]
    pd.DataFrame(rows, columns=COLUMNS).to_csv(benchmark / "results.csv", index=False)
    assert main([str(benchmark), "--root", str(checkout)]) == 0
    kept = pd.read_csv(checkout / "configs" / "results" / "s.csv")
    assert kept["value"].tolist() == [0.25]
    for page in (checkout / "README.md", checkout / "configs" / "README.md"):
        assert "| pooled CPL | 0.25 |\n<!-- end -->" in page.read_text()


def test_what_is_missing_is_said(checkout, tmp_path, capsys):
    assert main([str(tmp_path / "nowhere"), "--root", str(checkout)]) == 2
    assert "nowhere" in capsys.readouterr().err
