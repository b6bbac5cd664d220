import json

import pytest
import torch

from popl_rl.data.saved import load_preferences
from popl_rl.raters.pairs import training_pool
from popl_rl.storage import load_tensordict
from popl_rl.web.label_store import LabelStore
from popl_rl.web.labels import choose_pairs, export, kept_pairs


def sorted_pairs(pairs):
    return [tuple(sorted(pair)) for pair in pairs.tolist()]


def test_uniform_pairs_are_different(steps, generator):
    pairs = sorted_pairs(choose_pairs(steps, "uniform", count=10, generator=generator))
    assert len(pairs) == len(set(pairs)) == 10
    everything = choose_pairs(steps, "uniform", count=100, generator=generator)
    assert len(set(sorted_pairs(everything))) <= 28


def test_pairs_from_the_same_state(segments, generator):
    with pytest.raises(ValueError, match="needs segments that say which state they go on from"):
        choose_pairs(segments, "start", count=5, generator=generator)
    start = torch.arange(len(segments)) // 4
    segments["info", "start"] = start.unsqueeze(1).expand(segments.shape)
    allowed = set(training_pool(segments).allowed.tolist())
    for kind in ("start", "uniform"):
        pairs = choose_pairs(segments, kind, count=20, generator=generator)
        assert set(pairs.flatten().tolist()) <= allowed
        same = (start[pairs[:, 0]] == start[pairs[:, 1]]).float().mean()
        assert same == 1 if kind == "start" else same < 0.5


def test_disagreement_asks_where_members_differ(policies, steps, generator):
    pairs = choose_pairs(steps, "disagreement", count=16, policies=policies, generator=generator)
    # Sixteen pairs hold an even and an odd segment; of the others nobody could tell anything.
    assert ((pairs.sum(1) % 2) == 1).all()
    with pytest.raises(ValueError, match="policies must be given for disagreement"):
        choose_pairs(steps, "disagreement", count=2, generator=generator)
    with pytest.raises(ValueError, match="kind must be uniform, start or disagreement, got 'x'"):
        choose_pairs(steps, "x", count=2, generator=generator)


def test_pairs_are_kept(tmp_path):
    path = tmp_path / "pairs.json"
    assert kept_pairs(path, torch.tensor([[3, 1]])) == [(3, 1)]
    assert kept_pairs(path, torch.tensor([[7, 8]])) == [(3, 1)]
    path.write_text("[[1]]")
    with pytest.raises(ValueError, match=r"pairs\.json is damaged"):
        kept_pairs(path)


def test_answers_become_data_to_train_on(tmp_path):
    store = LabelStore(
        tmp_path / "answers.sqlite",
        [(0, 1), (2, 3), (4, 5)],
        raters_per_pair=2,
        answers=3,
        attention=1,
    )
    assert export(store, tmp_path) == 0
    assert not (tmp_path / "preferences").exists()
    said = []
    for name, reply in (("Ann", 0), ("", 2)):
        rater = store.begin(name)
        while (question := store.question(rater)) is not None:
            store.answer(rater, question.position, reply)
            if question.expected is None:
                said.append([question.first, question.second, reply, rater.id - 1])
    for _ in range(2):  # again in the place of what is there
        assert export(store, tmp_path) == 6
    found = load_preferences(tmp_path / "preferences", num_segments=6)
    columns = [found["pair"], found["answer"].unsqueeze(1), found["rater"].unsqueeze(1)]
    assert torch.cat(columns, 1).tolist() == said
    assert set(load_tensordict(tmp_path / "preferences").keys()) == {"pair", "answer", "rater"}
    people = json.loads((tmp_path / "raters.json").read_text())
    assert [person["name"] for person in people] == ["Ann", ""]
    assert [person["checks"] for person in people] == [2, 2]
    assert people[1]["checks_passed"] == 0
    left = {path.name for path in tmp_path.iterdir() if path.is_dir()}
    assert left == {"preferences"}
    store.database.close()
