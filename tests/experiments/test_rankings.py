"""Rankings of people, from a file to hypotheses."""

import json

import numpy as np
import pytest
import torch

from popl_rl.algorithms.assembly import build_popl
from popl_rl.algorithms.em import EM
from popl_rl.algorithms.mixture_population import MixturePOPL
from popl_rl.algorithms.problem import Problem
from popl_rl.config import EMSettings, MixtureSettings, Training
from popl_rl.data.bank import SegmentBank
from popl_rl.data.comparisons import Comparisons
from popl_rl.data.readers.npz import read_npz
from popl_rl.data.readers.opening import guess_reader
from popl_rl.data.readers.rankings import read_rankings
from popl_rl.data.readers.table import read_table
from popl_rl.data.readers.writing import write_csv, write_npz
from popl_rl.evaluation.people import draw_questions
from popl_rl.models.reward_functions import RewardSpec


@pytest.fixture
def items(tmp_path):
    path = tmp_path / "items.csv"
    path.write_text("item,x0,x1\na,1,0\nb,0,1\nc,1,1\n007,0,0\n")
    return str(path)


ROWS = [["b", "a", "007"], ["c", "a"]]


@pytest.mark.parametrize("kind", ["csv", "list", "jsonl"])
def test_rankings_become_stages_of_their_rater(tmp_path, items, kind):
    path = tmp_path / f"rankings.{'jsonl' if kind == 'jsonl' else 'csv'}"
    if kind == "jsonl":
        lines = [json.dumps({"rater": f"p{n}", "ranking": row}) for n, row in enumerate(ROWS)]
    else:
        texts = [
            '"' + json.dumps(row).replace('"', '""') + '"' if kind == "list" else " > ".join(row)
            for row in ROWS
        ]
        lines = ["rater,ranking", *(f"p{n},{text}" for n, text in enumerate(texts))]
    path.write_text("\n".join(lines) + "\n")
    data = read_rankings(path, items=items)
    assert data.names.raters == ["p0", "p1"]
    assert data.preferences["ranking"].tolist() == [0, 0, 0, 1]
    said = Comparisons.from_preferences(data.preferences, cases="rater")
    chosen = list(zip(said.preferred.tolist(), said.other.tolist(), strict=True))
    assert chosen == [(1, 0), (1, 3), (0, 3), (2, 0)]
    assert said.case.tolist() == [0, 0, 0, 1]
    assert said.weight.tolist() == [0.5, 0.5, 1.0, 1.0]
    assert sorted(data.preferences["answer"].unique().tolist()) == [0, 1]


def test_rankings_without_raters_are_cases(tmp_path, items):
    path = tmp_path / "rankings.csv"
    path.write_text("ranking\nb a c\nc b\n")
    data = read_rankings(path, items=items)
    said = Comparisons.from_preferences(data.preferences, cases="preference")
    assert said.case.tolist() == [0, 0, 0, 1]
    assert torch.equal(said.sizes(), torch.tensor([2.0, 1.0]))


def test_what_makes_no_sense_is_told_with_its_rows(tmp_path, items):
    path = tmp_path / "rankings.csv"
    path.write_text('ranking\nb a d\nb\na b a\n"[1,"\n')
    with pytest.raises(ValueError, match="cannot be used") as error:
        read_rankings(path, items=items)
    text = str(error.value)
    assert "row 2: an item does not exist ('d')" in text
    assert "rows 3, 5: a ranking is a list" in text
    assert "row 4: an item is ranked twice" in text
    other = tmp_path / "other.csv"
    other.write_text("order\na b\n")
    with pytest.raises(ValueError, match="must have the column 'ranking'"):
        read_rankings(other, items=items)


def test_exported_rankings_are_read_again(tmp_path, items):
    path = tmp_path / "rankings.csv"
    path.write_text("rater,ranking\np,b a c\np,c b\n")
    assert guess_reader(path) == "rankings"
    data = read_rankings(path, items=items)
    write_csv(data, tmp_path / "out")
    write_npz(data, tmp_path / "out.npz")
    told = tmp_path / "out" / "comparisons.csv"
    assert guess_reader(told) == "table"
    again = read_table(told, items=str(tmp_path / "out" / "items.csv"))
    for found in (again, read_npz(tmp_path / "out.npz")):
        for key in ("pair", "answer", "ranking"):
            assert torch.equal(found.preferences[key], data.preferences[key])


def test_people_may_each_number_their_own_rankings(tmp_path, items):
    path = tmp_path / "said.csv"
    rows = ["p,b,a,0,1", "q,b,a,0,1", "p,b,c,0,1", "q,a,c,1,", "p,c,a,0,2"]
    path.write_text("\n".join(["rater,first,second,answer,ranking", *rows, ""]))
    data = read_table(path, items=items)
    assert data.preferences["ranking"].tolist() == [0, 1, 0, -1, 2]
    write_npz(data, tmp_path / "said.npz")
    held = dict(np.load(tmp_path / "said.npz"))
    np.savez(tmp_path / "own.npz", **{**held, "ranking": [1, 1, 1, -1, 2]})
    again = read_npz(tmp_path / "own.npz").preferences
    assert torch.equal(again["ranking"], data.preferences["ranking"])
    said = Comparisons.from_preferences(again, cases="rater")
    assert said.sizes().tolist() == [2.0, 2.0]  # b and c, each of both


def ranked_by(weights, *, people, generator):
    """Five rankings of four of 40 items by each person, half of whom want the opposite."""
    features = torch.randn(40, 3, generator=generator)
    score = features @ torch.tensor(weights)
    rows = []
    for person in range(people):
        sign = 1 if person % 2 else -1
        for _ in range(5):
            some = torch.randperm(40, generator=generator)[:4]
            noise = torch.rand(4, generator=generator).log().neg().log().neg()  # Gumbel's
            order = some[(sign * score[some] + noise).argsort(descending=True)].tolist()
            rows.append(f"p{person}," + " > ".join(f"i{one}" for one in order))
    table = ["item,x0,x1,x2"]
    table += [f"i{n}," + ",".join(map(str, row)) for n, row in enumerate(features.tolist())]
    return "\n".join(table) + "\n", "rater,ranking\n" + "\n".join(rows) + "\n"


def test_groups_are_told_apart_by_their_rankings(tmp_path):
    generator = torch.Generator().manual_seed(0)
    items, rankings = ranked_by([2.0, -1.0, 1.0], people=20, generator=generator)
    (tmp_path / "items.csv").write_text(items)
    (tmp_path / "rankings.csv").write_text(rankings)
    data = read_rankings(tmp_path / "rankings.csv", items=str(tmp_path / "items.csv"))
    said = Comparisons.from_preferences(data.preferences, cases="rater")
    assert len(said) == 20 * 5 * 6
    assert round(float(said.sizes().sum())) == 20 * 5 * 3  # three stages of each ranking
    bank = SegmentBank.from_segments(data.segments)
    training = Training(steps=150, learning_rate=0.05, alpha=1.0)
    problem = Problem(RewardSpec(3, 1, ()), bank, said, training, members=4, generations=10)
    method = EM(problem, em=EMSettings(groups=2), generator=generator)
    while method.generation < method.generations:
        method.step()
    accuracy = problem.pass_shares(method.result().population).values
    assert float(accuracy.amax(0).mean()) > 0.8
    chosen = accuracy.argmax(0)
    assert len({int(chosen[0]), int(chosen[1])}) == 2
    questions = draw_questions(said, range(20), most=12, generator=generator)
    for asked, told, judged, mask in zip(*questions_of(questions), strict=True):
        assert not {*said.answer[asked[:told]].tolist()} & {*said.answer[judged[mask]].tolist()}


def test_rankings_of_nobody_known_are_learnt_from_by_mixtures(tmp_path):
    generator = torch.Generator().manual_seed(0)
    items, rankings = ranked_by([2.0, -1.0, 1.0], people=20, generator=generator)
    (tmp_path / "items.csv").write_text(items)
    (tmp_path / "rankings.csv").write_text(rankings)
    data = read_rankings(tmp_path / "rankings.csv", items=str(tmp_path / "items.csv"))
    said = Comparisons.from_preferences(data.preferences, cases="preference")
    bank = SegmentBank.from_segments(data.segments)
    training = Training(steps=150, learning_rate=0.05, alpha=1.0)
    problem = Problem(RewardSpec(3, 1, ()), bank, said, training, members=6, generations=4)
    settings = MixtureSettings(
        mixtures=3, generations=6, steps=30, first_selection=2, final_steps=60
    )
    method = build_popl(problem, mixture=settings, generator=generator)
    assert isinstance(method, MixturePOPL)
    while method.generation < method.generations:
        method.step()
    found = method.result()
    accuracy = problem.pass_shares(found.population).values
    assert accuracy.shape == (len(found), 100)
    assert float(accuracy.mean(1).amax()) < 0.6  # half of the people want the opposite
    assert float(accuracy.amax(0).mean()) > 0.7
    assert found.fair_among(bank, said) == int(accuracy.mean(1).argmax())


def questions_of(questions):
    return questions.asked, questions.told, questions.judged, questions.mask
