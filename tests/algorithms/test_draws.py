import pytest
import torch

from popl_rl.algorithms.draws import by_case, by_comparison, uniform
from popl_rl.data.comparisons import Comparisons

#: Cases in no order, of different sizes; nobody has answered as case 2.
CASE = torch.tensor([3, 0, 0, 1, 3, 0, 4, 3, 3])
OWN = torch.tensor([1.0, 0.5, 1.0, 1.0, 0.25, 0.5, 1.0, 1.0, 0.75])
#: How often each of two members draws each case.
WEIGHT = torch.tensor([[1.0, 0.0, 5.0, 2.0, 0.0], [0.0, 3.0, 1.0, 0.1, 1.0]])


@pytest.fixture(params=["few", "many"])
def many(request, monkeypatch):
    """Whether comparisons are drawn as if there were too many for ``torch.multinomial``."""
    if request.param == "many":
        monkeypatch.setattr("popl_rl.algorithms.draws._FEW", 0)


@pytest.mark.usefixtures("many")
@pytest.mark.parametrize("own", [None, OWN])
@pytest.mark.parametrize("of", ["case", "comparison", "uniform"])
def test_comparisons_are_drawn_as_their_weights_say(generator, own, of):
    rows = torch.arange(len(CASE))
    comparisons = Comparisons(rows, rows + 9, CASE, 5, weight=own)
    spread = WEIGHT[:, CASE]
    if of == "case":
        draws = by_case(comparisons, WEIGHT, least=0.0)
    elif of == "comparison":
        draws = by_comparison(comparisons, spread, least=0.0)
    else:
        draws, spread = uniform(comparisons, 2), torch.ones(2, 9)
    chance = comparisons.weighted(spread)
    torch.testing.assert_close(draws.answers.float(), chance.sum(1))
    chance = chance / chance.sum(1, keepdim=True)
    drawn = draws(40_000, generator)
    assert drawn.shape == (2, 40_000)
    for member in range(2):
        share = drawn[member].bincount(minlength=9) / 40_000
        assert not bool(share[chance[member] == 0].any()), "what has no weight is never drawn"
        torch.testing.assert_close(share, chance[member], atol=0.012, rtol=0)
    assert not torch.equal(*draws(50, generator)), "each member draws its own"


def test_comparisons_in_the_order_of_their_cases():
    comparisons = Comparisons(CASE, CASE, CASE, 5, weight=OWN)
    grouped = comparisons.grouped
    assert grouped.order.tolist() == [1, 2, 5, 3, 0, 4, 7, 8, 6]
    assert grouped.total.tolist() == [0.5, 1.5, 2.0, 3.0, 4.0, 4.25, 5.25, 6.0, 7.0]
    assert grouped.last.tolist() == [2, 3, 3, 7, 8]
    assert grouped.stop.tolist() == [2.0, 3.0, 3.0, 6.0, 7.0]
    assert [len(CASE[part]) for part in comparisons.blocks(4)] == [4, 4, 1]
