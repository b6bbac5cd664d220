"""What is still to come is told once, from the time of one generation."""

from types import SimpleNamespace

import pytest

from popl_rl.config import Config
from popl_rl.experiments.foresight import Foresight


@pytest.fixture
def foresight():
    config = Config()
    config.method.training.steps, config.method.generations = 600, 60
    config.method.refinement.steps = 300
    method = SimpleNamespace(generations=60, population=[None] * 40, refinement=object())
    return Foresight(config, method, groups=3)


def test_it_follows_from_one_generation_by_hand(foresight):
    """A generation of ten steps takes a second, so that a step of all 40 members takes 0.1.

    The last training: 300 steps of five times eight members, 30 s. Pooled CPL and three oracles:
    600 steps of 4 networks, 60 s times 0.25 + 0.75 * 4 / 40.
    """
    total, parts = foresight.ahead(10, 1.0)
    assert total == pytest.approx(50 + 30 + 60 * (0.25 + 0.075))
    assert parts == ["50 generations", "one last training", "pooled CPL and 3 oracles"]


def test_it_is_told_once(foresight, capsys):
    foresight(1)
    assert capsys.readouterr().err == ""
    foresight(2)
    foresight(3)
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith("then the evaluation")
