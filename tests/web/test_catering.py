import pytest
import torch

from popl_rl.web.catering import Agreement, Caterer, candidate_pairs
from popl_rl.web.person_store import PersonStore, Served

FIRST, SECOND, TIE, SKIP = range(4)


@pytest.fixture
def store(tmp_path):
    store = PersonStore(tmp_path / "answers.sqlite", clock=lambda: 0.0)
    yield store
    store.database.close()


@pytest.fixture
def caterer_of(policies, steps, store):
    def make(pairs=((0, 1), (2, 3), (4, 5), (0, 2)), **changes):
        settings = {"questions": 3, "enough": 2.0, "further": 2, **changes}
        everybody = policies.subset([1])
        return Caterer(
            policies, steps, torch.tensor(pairs), everybody=everybody, store=store, **settings
        )

    return make


def prefer(caterer, person, question, action):
    """Answer as somebody who wants this action: it is that of segments with its parity."""
    reply = FIRST if question.first % 2 == action else SECOND
    assert caterer.store.answer(person, question.position, reply)


def find(caterer, action):
    """Somebody new, who answers all that is asked."""
    person = caterer.store.begin()
    asked = []
    while (question := caterer.next_question(person)) is not None:
        asked.append(tuple(sorted((question.first, question.second))))
        prefer(caterer, person, question, action)
    return person, asked


@pytest.mark.parametrize("action", [0, 1])
def test_people_find_the_policy_that_does_what_they_want(caterer_of, action):
    """Each answer about an even against an odd segment has the odds of 0.9 : 0.1 with 5 % slips.

    That is 0.95 * 0.9 + 0.05 * 0.1 = 0.86 against 0.14; three of them 0.86^3 against 0.14^3.
    """
    caterer = caterer_of()
    person, asked = find(caterer, action)
    assert set(asked) == {(0, 1), (2, 3), (4, 5)}  # never (0, 2), of which nothing can be learnt
    found = caterer.serve(person)
    assert found.member == action
    expected = 0.86**3 / (0.86**3 + 0.14**3)
    assert float(found.weights[action]) == pytest.approx(expected, abs=1e-5)
    served = caterer.store.served(person)
    assert (served.member, served.suits) == (action, None)
    assert served.belief == pytest.approx(expected, abs=1e-5)


def test_asking_ends_when_enough_is_known(caterer_of):
    _, asked = find(caterer_of(enough=0.85), 0)
    assert len(asked) == 1
    _, asked = find(caterer_of(enough=0.95), 0)
    assert len(asked) == 2


def test_skips_say_nothing_and_count(caterer_of):
    caterer = caterer_of()
    person = caterer.store.begin()
    seen = set()
    for reply in (SKIP, TIE, SKIP):
        question = caterer.next_question(person)
        seen.add(frozenset((question.first, question.second)))
        caterer.store.answer(person, question.position, reply)
        assert caterer.found(caterer.store.asked(person)).weights.tolist() == [0.5, 0.5]
    assert caterer.next_question(person) is None
    assert len(seen) == 3


def test_a_question_stays_until_it_is_answered_and_can_be_undone(caterer_of):
    caterer = caterer_of()
    person = caterer.store.begin()
    question = caterer.next_question(person)
    assert caterer.next_question(person) == question
    prefer(caterer, person, question, 0)
    later = caterer.next_question(person)
    assert later.position == 2
    assert caterer.store.undo(person)
    assert caterer.next_question(person) == question
    assert not caterer.store.undo(person)
    caterer.serve(person)
    assert not caterer.store.undo(person)


def test_what_was_served_stays_served(caterer_of):
    caterer = caterer_of([(0, 1), (2, 3), (4, 5), (6, 7), (0, 3)])
    person, _ = find(caterer, 0)
    assert caterer.serve(person).member == 0
    for _ in range(2):
        question = caterer.further_question(person)
        assert caterer.further_question(person) == question
        assert question.further
        # Now the person wants the opposite.
        prefer(caterer, person, question, 1)
    assert caterer.further_question(person) is None
    assert caterer.serve(person).member == 0
    assert caterer.store.judge(person, suits=False)
    assert caterer.store.served(person).suits is False
    assert caterer.next_question(person) is None


def test_agreement_is_with_later_answers(caterer_of):
    pairs = [(0, 1), (2, 3), (4, 5), (6, 7), (0, 3)]
    caterer = caterer_of(pairs)
    person, _ = find(caterer, 0)
    caterer.serve(person)
    prefer(caterer, person, caterer.further_question(person), 0)
    question = caterer.further_question(person)
    caterer.store.answer(person, question.position, TIE)
    asked = caterer.store.asked(person)
    assert caterer.agreement(asked, 0, further=False) == Agreement(3, 0, 3)
    assert caterer.agreement(asked, 0, further=True) == Agreement(1, 0, 1)
    stranger = caterer.store.begin()
    [row, other] = caterer.rows()
    assert other["person"] == stranger.id
    assert (other["member"], other["later_answers"]) == (None, 0)
    assert (row["answers"], row["member"], row["suits"]) == (3, 0, None)
    assert (row["agree"], row["agree_everybody"], row["later_answers"]) == (1, 0, 1)


def test_answers_outside_of_ones_own_questions_are_refused(caterer_of):
    caterer = caterer_of()
    one, other = caterer.store.begin(), caterer.store.begin()
    caterer.next_question(one)
    for person, position in ((other, 1), (one, 2), (one, 0)):
        with pytest.raises(KeyError):
            caterer.store.answer(person, position, FIRST)
    with pytest.raises(ValueError, match=r"answer must be one of \[0, 1, 2, 3\], got 4"):
        caterer.store.answer(one, 1, 4)
    assert caterer.store.answer(one, 1, FIRST)
    assert not caterer.store.answer(one, 1, SECOND)
    assert not caterer.store.judge(one, suits=True)


def test_a_restart_loses_nothing(caterer_of, store, tmp_path):
    caterer = caterer_of()
    person, _ = find(caterer, 1)
    caterer.serve(person)
    again = PersonStore(tmp_path / "answers.sqlite")
    assert again.person(person.token) == person
    assert again.asked(person) == store.asked(person)
    assert again.served(person) == store.served(person)
    assert again.serve(person, 0, 0.5) == Served(1, store.served(person).belief)
    again.database.close()


def test_what_a_member_likes_best(caterer_of):
    pairs = [(first, second) for first in range(8) for second in range(first)]
    caterer = caterer_of(pairs)
    assert all(segment % 2 == 0 for segment in caterer.favourites(0))
    assert all(segment % 2 == 1 for segment in caterer.favourites(1))
    assert caterer.favourites(None) == caterer.favourites(1)
    assert len(caterer.favourites(0, count=2)) == 2


def test_candidates_are_of_few_segments(segments, generator):
    pairs = candidate_pairs(segments, candidates=200, most=6, generator=generator)
    assert pairs.shape == (200, 2)
    assert len(pairs.unique()) == 6
    assert (pairs[:, 0] != pairs[:, 1]).all()
    start = torch.arange(len(segments)) // 4
    segments["info", "start"] = start.unsqueeze(1).expand(segments.shape)
    pairs = candidate_pairs(segments, candidates=200, most=9, generator=generator)
    assert len(pairs.unique()) == 8
    assert (start[pairs[:, 0]] == start[pairs[:, 1]]).all()
