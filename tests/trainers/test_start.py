"""Starting up is part of the interface: what only needs settings imports no torch."""

import subprocess
import sys

import pytest

HEAVY = ("torch", "torchrl", "tensordict", "matplotlib", "pandas", "wandb", "scipy", "gymnasium")
SCRIPT = """
import sys
sys.argv = ["popl-train", *sys.argv[1:]]
from popl_rl.trainers.train_popl import cli
code = 0
try:
    cli()
except SystemExit as error:
    code = error.code or 0
print("imported:", *[name for name in {heavy} if name in sys.modules], file=sys.stderr)
sys.exit(code)
"""


def start(*arguments):
    """Exit code and what was printed by popl-train, with heavy packages that it imported."""
    command = [sys.executable, "-c", SCRIPT.format(heavy=HEAVY), *arguments]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=60)
    text, _, imported = done.stderr.rpartition("imported:")
    return done.returncode, done.stdout + text, imported.split()


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["--help"], 0, "checkpoint_interval"),
        (["--cfg", "job"], 0, "alpha"),
        (["method.training.alpha=-1"], 2, "method.training.alpha must be positive, got -1.0"),
        (["method.em.groups=3"], 2, "method.em.groups is not read by method 'popl'"),
        (["method=nonsense"], 2, "method/nonsense"),
        (["method.nonsense=1"], 2, "nonsense"),
        (["raters.shares=[1.0]"], 2, "raters.shares must be one number per group (2), got [1.0]"),
    ],
)
def test_what_needs_only_settings_imports_nothing_heavy(arguments, code, said):
    found, text, imported = start(*arguments)
    assert said in text
    assert found == code
    assert imported == []
