"""The check of a selection rule, with a good one and many faulty ones."""

import pytest
import torch

from popl_rl.selection.rules import best_sum_selection, random_selection, tournament_selection
from popl_rl.testing import check_selection


def lucky_case(values, count, *, generator):
    case = torch.randint(values.shape[1], (count,), generator=generator)
    return values.argmax(0)[case]


def changes_the_values(values, count, *, generator):
    values -= values.mean(0)
    return best_sum_selection(values, count, generator=generator)


def returns_a_list(values, count, *, generator):
    return lucky_case(values, count, generator=generator).tolist()


def returns_int32(values, count, *, generator):
    return lucky_case(values, count, generator=generator).int()


def one_of_each(values, count, *, generator):
    return torch.randperm(len(values), generator=generator)


def a_column(values, count, *, generator):
    return lucky_case(values, count, generator=generator).unsqueeze(1)


def takes_cases_for_members(values, count, *, generator):
    return torch.randint(values.shape[1] + 5, (count,), generator=generator)


def counts_from_one(values, count, *, generator):
    return 1 + lucky_case(values, count, generator=generator)


def of_its_own_randomness(values, count, *, generator):
    return torch.randint(len(values), (count,))


class Rotating:
    """Goes on where the last call stopped."""

    __name__ = "rotating"
    calls = 0

    def __call__(self, values, count, **_):
        self.calls += 1
        return torch.arange(self.calls, self.calls + count) % len(values)


def needs_many_members(values, count, *, generator):
    return torch.multinomial(torch.ones(len(values)), 2, generator=generator)[:1].expand(count)


def without_a_generator(values, count):
    return torch.zeros(count, dtype=torch.long)


BROKEN = [
    (changes_the_values, ValueError, "must leave values as they are, but changed them; work on"),
    (returns_a_list, TypeError, "must return a tensor of int64.*got list; use torch.tensor"),
    (returns_int32, TypeError, "got torch.int32"),
    (one_of_each, ValueError, r"must return \[64\] parents of random values, got shape \[9\]"),
    (a_column, ValueError, r"got shape \[64, 1\]"),
    (takes_cases_for_members, ValueError, r"must return rows of values, 0\.\.8 for random values"),
    (counts_from_one, ValueError, r"must return rows of values, 0\.\.\d"),
    (of_its_own_randomness, ValueError, "must draw from the generator that it is given"),
    (Rotating(), ValueError, "'rotating' must choose the same parents from one seed"),
    (needs_many_members, ValueError, "selecting 3 of one member.* failed with RuntimeError"),
    (without_a_generator, ValueError, "failed with TypeError.*unexpected keyword argument"),
]


@pytest.mark.parametrize(("rule", "error", "message"), BROKEN)
def test_each_fault_of_a_rule_is_found(rule, error, message):
    with pytest.raises(error, match=message):
        check_selection(rule)


@pytest.mark.parametrize("rule", [lucky_case, random_selection])
def test_good_rules_pass_and_leave_the_global_randomness_alone(rule):
    before = torch.random.get_rng_state()
    check_selection(rule)
    assert torch.equal(torch.random.get_rng_state(), before)


def test_who_takes_low_values_for_good_is_warned():
    def lowest(values, count, *, generator):
        return best_sum_selection(-values, count, generator=generator)

    with pytest.warns(UserWarning, match="'lowest' takes the member that is worst on every case"):
        check_selection(lowest)


def test_arguments_are_passed_on():
    check_selection("tournament", size=1)
    check_selection(tournament_selection, size=2)
    with pytest.raises(ValueError, match="size must be at least 1, got 0"):
        check_selection("tournament", size=0)
    with pytest.raises(ValueError, match="unknown selection 'lexicas'"):
        check_selection("lexicas")
