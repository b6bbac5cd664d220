"""Starting up is part of the interface: what only needs settings imports no torch."""

import json
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
#: Commands one after the other in one process, which loads what they need of settings once.
SCRIPT = """
import contextlib, importlib, io, json, sys

for script, arguments in json.loads(sys.argv[1]):
    sys.argv[1:] = arguments
    code, text = 0, io.StringIO()
    with contextlib.redirect_stdout(text), contextlib.redirect_stderr(text):
        try:
            importlib.import_module(f"popl_rl.trainers.{{script}}").cli()
        except SystemExit as error:
            code = error.code or 0
    imported = [name for name in {heavy} if name in sys.modules]
    print(json.dumps([code, text.getvalue(), imported]))
"""

TRAIN = [
    (["--help"], 0, "checkpoint_interval"),
    (["--cfg", "job"], 0, "alpha"),
    (["method.training.alpha=-1"], 2, "method.training.alpha must be positive, got -1.0"),
    (["method.em.groups=3"], 2, "method.em.groups is not read by method 'popl'"),
    (["method=nonsense"], 2, "unknown method 'nonsense'"),
    (["method.nonsense=1"], 2, "nonsense"),
    (["raters.shares=[1.0]"], 2, "raters.shares must be one number per group (2), got [1.0]"),
]
EVALUATE = [
    (["--help"], 0, "run_dir"),
    (["run_dir=nowhere"], 2, "nowhere has no config.yaml; give the folder of a run"),
    (["run_dir=mine", "evaluation.answers=0"], 2, "evaluation.answers must be at least 1"),
    (["run_dir=mine", "evaluation.anwsers=3"], 2, "anwsers"),
]
BENCHMARK = [
    (["--help"], 0, "workers"),
    (["suite=smok"], 2, "smok"),
    (["suite=smoke", "seeds=0"], 2, "seeds must be at least 1, got 0"),
    (["suite=smoke", "workers=-1"], 2, "workers must be at least 0, got -1"),
    (["suite=smoke", "cell=999"], 2, "cell must be from 0 to"),
    (["suite=mine.yaml"], 2, "method.training.alpha must be positive"),
]
LABEL = [
    (["--help"], 0, "raters_per_pair"),
    (["out=x", "label.pairs=odd"], 2, "label.pairs must be uniform, start,"),
    (["out=x", "label.pairs=disagreement"], 2, "label.policies must be the"),
    (["out=x", "page.prot=1"], 2, "prot"),
    (["out=x", "data.load=nowhere"], 2, "data.load must be"),
]
SERVE = [
    (["--help"], 0, "candidates"),
    (["run_dir=nowhere"], 2, "nowhere has no config.yaml"),
    (["run_dir=x", "serve.questions=0"], 2, "serve.questions must be"),
]
CASES = {
    "train_popl": TRAIN,
    "evaluate_policies": EVALUATE,
    "run_benchmark": BENCHMARK,
    "label_pairs": LABEL,
    "serve_policies": SERVE,
}


COMMANDS = [(script, *case) for script, cases in CASES.items() for case in cases]


@pytest.fixture(scope="module")
def ends(tmp_path_factory):
    """How each command ends: exit code, what is printed, what has been imported so far."""
    folder = tmp_path_factory.mktemp("start")
    (folder / "mine.yaml").write_text(SUITE)
    (folder / "mine").mkdir()
    config = OmegaConf.structured(Config(raters=RatersConfig(groups=["upper", "lower"])))
    (folder / "mine" / "config.yaml").write_text(OmegaConf.to_yaml(config))
    commands = json.dumps([(script, arguments) for script, arguments, _, _ in COMMANDS])
    program = [sys.executable, "-c", SCRIPT.format(heavy=HEAVY), commands]
    lines = subprocess.check_output(program, text=True, timeout=60, cwd=folder).splitlines()
    assert not (folder / "x").exists()
    return [json.loads(line) for line in lines]


@pytest.mark.parametrize(
    ("number", "script", "arguments", "code", "said"),
    [(number, *command) for number, command in enumerate(COMMANDS)],
)
def test_what_needs_only_settings_is_told_at_once(ends, number, script, arguments, code, said):
    found, text, imported = ends[number]
    assert said in text
    assert found == code
    assert imported == []
