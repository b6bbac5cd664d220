"""The command ``python -m popl_rl.testing``."""

import runpy
import sys

import pytest

from popl_rl.testing.command import main


def test_command_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text("def rude(segments):\n    return segments['shoe\\nsize']\n")
    assert main(["env", "two_doors", "--with", "doors=3", "start=anywhere"]) == 0
    assert capsys.readouterr().out == "env two_doors: all checks passed\n"
    assert main(["rater", "lower", "--env", "two_doors", "--with", "size=7"]) == 0
    assert capsys.readouterr().out == "rater lower: all checks passed\n"
    assert main(["rater", "mine.py:rude"]) == 2
    faults = capsys.readouterr()
    assert faults.out == ""
    assert faults.err.startswith("rater 'rude': judging segments")
    assert faults.err.count("\n") == 1
    assert main(["env", "two_door"]) == 2
    assert "Did you mean 'two_doors'?" in capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments", [[], ["env"], ["env", "two_doors", "--with", "doors"], ["features", "a:b"]]
)
def test_command_line_misuse(arguments, capsys):
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == 2
    assert "usage: python -m popl_rl.testing" in capsys.readouterr().err


def test_module_runs(monkeypatch, capsys):
    monkeypatch.delitem(sys.modules, "popl_rl.testing.__main__", raising=False)
    monkeypatch.setattr(sys, "argv", ["testing", "env", "popl_rl.testing:tiny_env"])
    with pytest.raises(SystemExit) as left:
        runpy.run_module("popl_rl.testing", run_name="__main__")
    assert left.value.code == 0
    said = capsys.readouterr()
    assert said.out == "env popl_rl.testing:tiny_env: all checks passed\n"
    assert said.err == ""


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["selection", "tournament", "--with", "size=2"], "selection tournament"),
        (["features", "torch.nn:Flatten", "--env", "lava_gap"], "features torch.nn:Flatten"),
        (["method", "popl_rl.algorithms.multi_cpl:MultiCPL", "--learns", "reward"], "method popl"),
    ],
)
def test_what_is_built_in_passes(arguments, said, capsys):
    assert main(arguments) == 0
    written = capsys.readouterr()
    assert written.err == ""
    assert written.out.startswith(said)
    assert written.out.endswith("all checks passed\n")


def test_faults_of_other_kinds_are_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(
        "def first(values, count, *, generator):\n    return [0] * count\n\n\n"
        "def read(path):\n    return path.read_text()\n\n\n"
        "def blind(images):\n    raise RuntimeError('cannot\\nsee')\n\n\n"
        "class Lazy:\n    def __init__(self, problem, *, generator):\n        pass\n"
    )
    for arguments, fault in (
        (["selection", "mine.py:first"], "selection 'first' must return a tensor of int64"),
        (["features", "mine.py:blind", "--env", "lava_gap"], "features 'blind': reading obs"),
        (["reader", "mine.py:read", "--data", "mine.py"], "reader 'read' must return (segments, "),
        (["reader", "mine.py:read", "--data", "other.py"], "there is nothing at other.py"),
        (["method", "mine.py:Lazy"], "method 'Lazy' must have a method step()"),
    ):
        assert main(arguments) == 2
        written = capsys.readouterr()
        assert written.out == ""
        assert written.err.startswith(fault)
        assert written.err.count("\n") == 1
