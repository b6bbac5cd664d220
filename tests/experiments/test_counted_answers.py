"""Learning curves count answers, of which each ranking and each tie is one."""

from types import SimpleNamespace

import torch
from tensordict import TensorDict

from popl_rl.algorithms.problem import Problem
from popl_rl.config import Training
from popl_rl.data.bank import SegmentBank
from popl_rl.data.comparisons import Comparisons
from popl_rl.experiments import learning_curve as curves
from popl_rl.models.reward_functions import RewardSpec


def problem_of(ties="drop", **more):
    """Four raters with 15 comparisons each of three segments."""
    pair = torch.tensor([[0, 1], [0, 2], [1, 2]]).repeat(20, 1)
    rater = torch.arange(4).repeat_interleave(15)
    data = {"pair": pair, "answer": torch.zeros(60).long(), "rater": rater, **more}
    said = Comparisons.from_preferences(TensorDict(data, [60]), cases="rater", ties=ties)
    bank = SegmentBank(torch.rand(3, 1), torch.arange(3)[:, None], torch.zeros(3, 1).long(), False)
    return Problem(RewardSpec(1, 1, ()), bank, said, Training())


def told(problem, most, monkeypatch, folder):
    """The curve of a method that learns nothing, where up to ``most`` answers are too few."""
    idle = SimpleNamespace(generation=0, generations=0, result=lambda: None)
    monkeypatch.setattr(curves, "build_method", lambda *_, **__: idle)
    monkeypatch.setattr(curves, "_wrong", lambda *_: torch.tensor([0.2, 0.3, 0.4]))
    config = SimpleNamespace(
        evaluation=SimpleNamespace(learning_curve=most),
        method=SimpleNamespace(cases="rater"),
        seed=0,
        device="cpu",
    )
    setting = SimpleNamespace(problem=problem, groups=(), evaluator=None)
    return curves.learning_curve(config, setting, None, folder)


def test_five_rankings_of_three_are_five_answers(monkeypatch, tmp_path):
    problem = problem_of(ranking=torch.arange(20).repeat_interleave(3))
    assert told(problem, 19, monkeypatch, tmp_path) is None
    assert told(problem, 20, monkeypatch, tmp_path).answers == (8, 12, 16, 20)


def test_the_halves_of_a_tie_are_one_answer(monkeypatch, tmp_path):
    problem = problem_of("count", answer=torch.arange(60) % 3)
    assert len(problem.comparisons) == 80
    assert told(problem, 59, monkeypatch, tmp_path) is None
    assert told(problem, 60, monkeypatch, tmp_path).answers == (16, 32, 48, 60)
