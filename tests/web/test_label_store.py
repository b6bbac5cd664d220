import sqlite3
import threading
from collections import Counter

import pytest

from popl_rl.web.label_store import ATTENTION, Given, LabelStore

FIRST, SECOND, TIE = 0, 1, 2


class Clock:
    now = 0.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def store_of(tmp_path, clock):
    opened = []

    def make(pairs=((0, 1), (2, 3), (4, 5)), **changes):
        settings = {"raters_per_pair": 2, "answers": 10, "attention": 0, **changes}
        opened.append(LabelStore(tmp_path / "answers.sqlite", pairs, clock=clock, **settings))
        return opened[-1]

    yield make
    for store in opened:
        store.database.close()


def label(store, rater, answer=FIRST):
    """Answer all that is asked; the pairs, as they were shown."""
    shown = []
    while (question := store.question(rater)) is not None:
        shown.append((question.first, question.second))
        assert store.answer(rater, question.position, answer)
    return shown


def test_a_rater_is_asked_each_pair_once(store_of):
    store = store_of()
    rater = store.begin("Ann")
    assert store.rater(rater.token) == rater
    assert store.rater("guess") is None
    shown = label(store, rater)
    assert sorted(map(sorted, shown)) == [[0, 1], [2, 3], [4, 5]]
    assert store.answered(rater) == 3
    assert store.given() == [Given(rater.id, *pair, FIRST) for pair in shown]


def test_a_question_stays_until_it_is_answered(store_of):
    store = store_of()
    rater = store.begin("")
    question = store.question(rater)
    assert store.question(rater) == question
    assert store.answer(rater, question.position, SECOND, 1.5)
    assert not store.answer(rater, question.position, FIRST)  # a second click
    assert [given.answer for given in store.given()] == [SECOND]
    assert store.question(rater).position == 2
    assert store.database.one("SELECT seconds FROM answer") == (1.5,)


def test_answers_outside_of_ones_own_questions_are_refused(store_of):
    store = store_of()
    one, other = store.begin(""), store.begin("")
    store.question(one)
    with pytest.raises(KeyError):
        store.answer(other, 1, FIRST)
    with pytest.raises(KeyError):
        store.answer(one, 2, FIRST)
    with pytest.raises(ValueError, match=r"answer must be one of \[0, 1, 2, 3\], got 7"):
        store.answer(one, 1, 7)
    assert store.given() == []


def test_pairs_go_to_as_many_raters_as_wanted(store_of):
    store = store_of(raters_per_pair=2)
    raters = [store.begin("") for _ in range(3)]
    shown = [label(store, rater) for rater in raters]
    assert [len(pairs) for pairs in shown] == [3, 3, 0]
    times = Counter(tuple(sorted(pair)) for pairs in shown for pair in pairs)
    assert set(times.values()) == {2}


def test_the_pair_with_fewest_raters_comes_first(store_of):
    store = store_of(answers=1, raters_per_pair=5)
    shown = [label(store, store.begin(""))[0] for _ in range(6)]
    assert set(Counter(tuple(sorted(pair)) for pair in shown).values()) == {2}


def test_what_somebody_left_open_is_free_again_later(store_of, clock):
    store = store_of(pairs=[(0, 1)], raters_per_pair=1)
    gone, other = store.begin(""), store.begin("")
    assert store.question(gone) is not None
    assert store.question(other) is None
    clock.now = 1801.0
    assert store.question(other) is not None


def test_undo_asks_the_last_question_again_and_keeps_what_was_said(store_of):
    store = store_of()
    rater = store.begin("")
    assert not store.undo(rater)
    question = store.question(rater)
    store.answer(rater, question.position, FIRST)
    store.question(rater)
    assert store.undo(rater)
    assert store.question(rater) == question
    assert store.given() == []
    assert store.answer(rater, question.position, TIE)
    assert [given.answer for given in store.given()] == [TIE]
    assert store.database.one("SELECT COUNT(*) FROM answer") == (2,)


def test_attention_checks_come_now_and_then_and_are_no_data(store_of):
    pairs = [(2 * i, 2 * i + 1) for i in range(7)]
    store = store_of(pairs, attention=3, answers=7)
    rater = store.begin("")
    label(store, rater, FIRST)
    asked = store.database.all("SELECT pair, expected FROM question ORDER BY position")
    assert [pair == ATTENTION for pair, _ in asked] == [False, False, False, True] * 2 + [False]
    assert len(store.given()) == store.answered(rater) == 7
    passed = sum(expected == FIRST for pair, expected in asked if pair == ATTENTION)
    assert store.attention_checks() == {rater.id: (passed, 2)}


def test_sides_are_drawn(store_of):
    pairs = [(2 * i, 2 * i + 1) for i in range(40)]
    store = store_of(pairs, answers=40)
    shown = label(store, store.begin(""))
    swapped = sum(first > second for first, second in shown)
    assert 8 < swapped < 32


def test_a_restart_loses_nothing(store_of):
    store = store_of()
    rater = store.begin("Ann")
    question = store.question(rater)
    store.answer(rater, question.position, SECOND)
    following = store.question(rater)
    again = store_of()
    assert again.rater(rater.token) == rater
    assert again.given() == store.given()
    assert again.question(rater) == following


def test_many_raters_at_once_lose_and_double_nothing(store_of):
    pairs = [(2 * i, 2 * i + 1) for i in range(8)]
    store = store_of(pairs, raters_per_pair=3, answers=5)
    confirmed = []

    def work():
        rater = store.begin("")
        while (question := store.question(rater)) is not None:
            if store.answer(rater, question.position, FIRST):
                confirmed.append((rater.id, question.first, question.second, FIRST))

    threads = [threading.Thread(target=work) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    kept = [(g.rater, g.first, g.second, g.answer) for g in store.given()]
    assert sorted(kept) == sorted(confirmed)
    times = Counter(tuple(sorted(pair)) for _, *pair, _ in kept)
    assert max(times.values()) <= 3


def test_other_files_are_refused(tmp_path):
    settings = {"raters_per_pair": 1, "answers": 1, "attention": 0}
    (tmp_path / "text").write_text("no database, but long enough to be looked at" * 50)
    with pytest.raises(ValueError, match="is not readable as a database of answers"):
        LabelStore(tmp_path / "text", [(0, 1)], **settings)
    other = sqlite3.connect(tmp_path / "other")
    other.execute("CREATE TABLE about (name TEXT PRIMARY KEY, value TEXT NOT NULL)")
    other.execute("INSERT INTO about VALUES ('form', 'else')")
    other.commit()
    other.close()
    with pytest.raises(ValueError, match=r"holds 'else', expected 'popl_rl\.labels/1'"):
        LabelStore(tmp_path / "other", [(0, 1)], **settings)
