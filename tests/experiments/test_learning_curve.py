"""A run on few answers says how many are missing."""

from dataclasses import replace

import pandas as pd
import torch

from popl_rl.data.comparisons import Comparisons
from popl_rl.evaluation.learning_curves import fit_learning_curve
from popl_rl.experiments.learning_curve import fewer_answers
from popl_rl.trainers import train_popl


def test_fewer_answers_of_everybody():
    """Raters with 3, 1 and 5 answers; the halves of one answer stay together."""
    case = torch.tensor([0, 2, 2, 0, 1, 2, 2, 0, 2])
    all_of_them = Comparisons(torch.arange(9), torch.arange(9) + 9, case, 3)
    few, more = (
        fewer_answers(all_of_them, count, generator=torch.Generator().manual_seed(0))
        for count in (1, 3)
    )
    assert few.sizes().tolist() == [1, 1, 1]
    assert more.sizes().tolist() == [3, 1, 3]
    assert set(few.preferred.tolist()) < set(more.preferred.tolist())
    assert torch.equal(more.other, more.preferred + 9)
    halves = Comparisons(torch.arange(4), torch.arange(4), torch.zeros(4).long(), 1)
    halves = halves.rows(torch.arange(4))
    object.__setattr__(halves, "answer", torch.tensor([0, 0, 1, 1]))
    kept = fewer_answers(halves, 1, generator=torch.Generator().manual_seed(0))
    assert kept.preferred.tolist() in ([0, 1], [2, 3])


def test_a_run_on_few_answers_tells(config_of, tiny, tmp_path, capsys, monkeypatch):
    def needs_more(answers, wrong, error):
        """What was measured, but with a fit by which 400 answers are needed."""
        fitted = fit_learning_curve(answers, wrong, error)
        return replace(fitted, needed=400, between=(300, 500))

    # Sets of so short a training learn little, so that nothing may be missing by itself.
    monkeypatch.setattr("popl_rl.experiments.learning_curve.fit_learning_curve", needs_more)
    result = train_popl.run(
        config_of(
            *tiny[1:],
            "env=hidden_utility",
            "raters=cycle",
            "raters.answers=5",
            "evaluation.curve=[]",
            "evaluation.history=0",
            "evaluation.reward_baselines=false",
            "evaluation.learning_curve=40",
            f"run_dir={tmp_path / 'run'}",
        )
    )
    curve = pd.read_csv(tmp_path / "run" / "learning_curve.csv")
    assert curve["answers"].tolist() == [16, 24, 32, 40]  # 2, 3, 4 and 5 answers of 8 raters
    assert curve["wrong"].between(0, 1).all()
    assert (curve["error"] > 0).all()
    said = "about 360 answers are missing (260 to 460; 45 more of each rater)"
    assert said in (tmp_path / "run" / "report.md").read_text()
    capsys.readouterr()
    train_popl.show(result)
    assert said in capsys.readouterr().out
