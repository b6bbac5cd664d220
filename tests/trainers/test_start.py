"""Starting up is part of the interface: what only needs settings imports no torch."""

import subprocess
import sys

import pytest
from omegaconf import OmegaConf

from popl_rl.config import Config, RatersConfig

#: A suite whose one scenario has a mistake.
SUITE = """
methods: {popl: []}
scenarios: {odd: {overrides: [method.training.alpha=-1]}}
"""
HEAVY = ("torch", "torchrl", "tensordict", "matplotlib", "pandas", "wandb", "scipy", "gymnasium")
SCRIPT = """
import sys
from popl_rl.trainers.{script} import cli
code = 0
try:
    cli()
except SystemExit as error:
    code = error.code or 0
print("imported:", *[name for name in {heavy} if name in sys.modules], file=sys.stderr)
sys.exit(code)
"""


def start(*arguments, script="train_popl", cwd=None):
    """Exit code and what was printed by a script, with heavy packages that it imported."""
    command = [sys.executable, "-c", SCRIPT.format(script=script, heavy=HEAVY), *arguments]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=60, cwd=cwd)
    text, _, imported = done.stderr.rpartition("imported:")
    return done.returncode, done.stdout + text, imported.split()


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["--help"], 0, "checkpoint_interval"),
        (["--cfg", "job"], 0, "alpha"),
        (["method.training.alpha=-1"], 2, "method.training.alpha must be positive, got -1.0"),
        (["method.em.groups=3"], 2, "method.em.groups is not read by method 'popl'"),
        (["method=nonsense"], 2, "unknown method 'nonsense'"),
        (["method.nonsense=1"], 2, "nonsense"),
        (["raters.shares=[1.0]"], 2, "raters.shares must be one number per group (2), got [1.0]"),
    ],
)
def test_what_needs_only_settings_imports_nothing_heavy(arguments, code, said):
    found, text, imported = start(*arguments)
    assert said in text
    assert found == code
    assert imported == []


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["--help"], 0, "run_dir"),
        (["run_dir=nowhere"], 2, "nowhere has no config.yaml; give the folder of a run"),
        (["run_dir=mine", "evaluation.answers=0"], 2, "evaluation.answers must be at least 1"),
        (["run_dir=mine", "evaluation.anwsers=3"], 2, "anwsers"),
    ],
)
def test_evaluating_tells_a_wrong_setting_at_once(tmp_path, arguments, code, said):
    (tmp_path / "mine").mkdir()
    config = OmegaConf.structured(Config(raters=RatersConfig(groups=["upper", "lower"])))
    (tmp_path / "mine" / "config.yaml").write_text(OmegaConf.to_yaml(config))
    found, text, imported = start(*arguments, script="evaluate_policies", cwd=tmp_path)
    assert said in text
    assert found == code
    assert imported == []


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["--help"], 0, "workers"),
        (["suite=smok"], 2, "smok"),
        (["suite=smoke", "seeds=0"], 2, "seeds must be at least 1, got 0"),
        (["suite=smoke", "workers=-1"], 2, "workers must be at least 0, got -1"),
        (["suite=smoke", "cell=999"], 2, "cell must be from 0 to"),
        (["suite=mine.yaml"], 2, "method.training.alpha must be positive"),
    ],
)
def test_a_benchmark_tells_a_wrong_setting_at_once(tmp_path, arguments, code, said):
    (tmp_path / "mine.yaml").write_text(SUITE)
    found, text, imported = start(*arguments, script="run_benchmark", cwd=tmp_path)
    assert said in text
    assert found == code
    assert imported == []


@pytest.mark.parametrize(
    ("script", "arguments", "code", "said"),
    [
        ("label_pairs", ["--help"], 0, "raters_per_pair"),
        ("label_pairs", ["out=x", "label.pairs=odd"], 2, "label.pairs must be uniform, start,"),
        (
            "label_pairs",
            ["out=x", "label.pairs=disagreement"],
            2,
            "label.policies must be the",
        ),
        ("label_pairs", ["out=x", "page.prot=1"], 2, "prot"),
        ("label_pairs", ["out=x", "data.load=nowhere"], 2, "data.load must be"),
        ("serve_policies", ["--help"], 0, "candidates"),
        ("serve_policies", ["run_dir=nowhere"], 2, "nowhere has no config.yaml"),
        (
            "serve_policies",
            ["run_dir=x", "serve.questions=0"],
            2,
            "serve.questions must be",
        ),
    ],
)
def test_pages_tell_a_wrong_setting_at_once(tmp_path, script, arguments, code, said):
    found, text, imported = start(*arguments, script=script, cwd=tmp_path)
    assert said in text
    assert found == code
    assert imported == []
    assert not (tmp_path / "x").exists()
