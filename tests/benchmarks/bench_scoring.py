"""Speed of scoring beside a matrix product of as many operations.

    pytest tests/benchmarks/bench_scoring.py -m benchmark

A ratio is the share of the reference's rate, in operations of the matrix products that scoring
needs per second. Biases, ReLU, log-probabilities and sums over steps count as nothing.
"""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from popl_rl.algorithms.losses import CPLLoss, descend
from popl_rl.data.bank import SegmentBank
from popl_rl.data.comparisons import Comparisons
from popl_rl.models.policies import PolicySpec
from popl_rl.models.population import Population
from popl_rl.models.reward_functions import RewardSpec
from popl_rl.models.scoring import segment_scores
from popl_rl.optim import adam

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(1800)]

WHOLE = PolicySpec(39, 4, False, (256, 256))
STEPS = 64


def continuous_bank(segments: int, steps: int = STEPS) -> SegmentBank:
    generator = torch.Generator().manual_seed(0)
    return SegmentBank(
        torch.randn(segments * steps, 39, generator=generator),
        torch.arange(segments * steps).view(segments, steps),
        2 * torch.rand(segments, steps, 4, generator=generator) - 1,
        False,
    )


def whole_population(members: int) -> Population:
    return Population.create(WHOLE, members, generator=torch.Generator().manual_seed(1))


def products(rows: int, inner: int, columns: int, number: int = 1) -> Callable[[], None]:
    """Matrix products into memory that is there already."""
    left, right = torch.randn(rows, inner), torch.randn(inner, columns)
    out = torch.empty(rows, columns)

    def run() -> None:
        for _ in range(number):
            torch.mm(left, right, out=out)

    return run


@pytest.mark.parametrize("shape", [(2048, 2048, 2048), (1024, 256, 256)])
def test_whole_networks(race: Any, shape: tuple[int, int, int]) -> None:
    """A 32nd of 2048 pairs: the time is linear in their number, see the next test."""
    population, bank = whole_population(64), continuous_bank(128)
    work = 64 * bank.row.numel() * (39 * 256 + 256 * 256 + 256 * 4)
    number = round(work / (shape[0] * shape[1] * shape[2]))
    ratio = race(
        "64 members 39-256-256-4 on 64 pairs x 2 x 64 steps",
        lambda: segment_scores(population, bank),
        products(*shape, number),
        reference=f"{number} times mm {shape[0]} x {shape[1]} x {shape[2]}",
        scale=work / (number * shape[0] * shape[1] * shape[2]),
        target=0.6,
        rounds=9,
    )
    assert ratio > 0.5  # the target, less what a loaded machine may take off


def test_training_steps(race: Any) -> None:
    """CPL steps of a stacked population; gradients take twice the products of scores."""
    members, batch = 16, 32
    population, bank = whole_population(members), continuous_bank(256)
    answers = torch.randint(256, (2, 4000), generator=torch.Generator().manual_seed(2))
    comparisons = Comparisons(*answers, torch.arange(4000) % 100, 100)
    loss = CPLLoss(population, bank, slip=0.05)
    optimizer = adam(population.members.parameters(), lr=1e-3)
    generator = torch.Generator().manual_seed(3)
    rows = members * batch * 2 * STEPS
    # Of the observations themselves no gradient is taken.
    work = rows * (2 * 39 * 256 + 3 * (256 * 256 + 256 * 4))
    number = round(work / 2048**3)
    ratio = race(
        f"a CPL step of {members} members 39-256-256-4 on {batch} pairs each x 2 x 64 steps",
        lambda: descend(
            loss, optimizer, comparisons, steps=1, batch_size=batch, generator=generator
        ),
        products(2048, 2048, 2048, number),
        reference=f"{number} times mm 2048 x 2048 x 2048",
        scale=work / (number * 2048**3),
        target=0.7,
        rounds=9,
    )
    assert ratio > 0.4


def test_whole_networks_on_all_pairs(race: Any, extra_memory: Any) -> None:
    population, bank = whole_population(64), continuous_bank(4096)
    results: list[Tensor] = []
    extra = extra_memory(lambda: results.append(segment_scores(population, bank)))
    work = 64 * bank.row.numel() * (39 * 256 + 256 * 256 + 256 * 4)
    number = 16
    race(
        f"64 members on 2048 pairs x 2 x 64 steps ({extra:.0f} MiB more, 1 of them the result)",
        lambda: segment_scores(population, bank),
        products(2048, 2048, 2048, number),
        reference=f"{number} times mm 2048 x 2048 x 2048, scaled",
        scale=work / (number * 2048**3),
        target=0.6,
        rounds=1,
    )
    assert not extra > 64


def heads(spec: PolicySpec | RewardSpec) -> Population:
    return Population.create(spec, 1000, evolve="head", generator=torch.Generator().manual_seed(1))


def test_reward_heads(race: Any, extra_memory: Any) -> None:
    """1000 heads of 512 weights on the 200 000 segments of 100 000 pairs, no segment twice."""
    population = heads(RewardSpec(39, 1, (512, 512)))
    bank = continuous_bank(200_000, steps=4)  # the number of steps matters to the trunk only
    bank = SegmentBank(bank.observation, bank.row, torch.zeros_like(bank.row), False)
    segment_scores(population, bank, memory_mb=1024.0)
    extra = extra_memory(lambda: segment_scores(population, bank, memory_mb=1024.0))
    left, right = torch.randn(200_000, 512), torch.randn(512, 1000)
    ratio = race(
        f"1000 reward heads on 100 000 pairs ({extra:.0f} MiB more, 763 of them the result)",
        lambda: segment_scores(population, bank, memory_mb=1024.0),
        lambda: torch.mm(left, right),
        reference="mm 200000 x 512 x 1000",
        target=0.6,
        rounds=5,
    )
    assert ratio > 0.5


def test_reward_heads_whose_features_may_not_be_kept(race: Any) -> None:
    """Half a budget of 8 MiB is less than the features take: the trunk looks again every time."""
    population = heads(RewardSpec(39, 1, (512, 512)))
    bank = continuous_bank(4000, steps=4)
    bank = SegmentBank(bank.observation, bank.row, torch.zeros_like(bank.row), False)
    race(
        "1000 reward heads on 2000 pairs of 4 steps, nothing kept",
        lambda: segment_scores(population, bank, memory_mb=8.0),
        lambda: segment_scores(population, bank),
        reference="the same, features kept",
        target=0,
        rounds=5,
    )


def test_policy_heads(race: Any) -> None:
    """Four outputs a step, each step on its own: a log-probability is not linear in the head."""
    population, bank = heads(PolicySpec(39, 4, False, (512, 512))), continuous_bank(128)
    ratio = race(
        "1000 policy heads on 64 pairs x 2 x 64 steps",
        lambda: segment_scores(population, bank),
        products(128 * STEPS, 512, 4000),
        reference=f"mm {128 * STEPS} x 512 x 4000",
        target=0.6,
        rounds=9,
    )
    assert ratio > 0.5


def test_looking_up(race: Any) -> None:
    """Few distinct observations and discrete actions, as in two_doors: against plain gathering."""
    generator = torch.Generator().manual_seed(0)
    population = Population.create(PolicySpec(8, 4, True), 64, generator=generator)
    row = torch.randint(200, (2000, 20), generator=generator)
    action = torch.randint(4, row.shape, generator=generator)
    bank = SegmentBank(torch.randn(200, 8, generator=generator), row, action, True)

    @torch.no_grad()
    def gather() -> Tensor:
        table = population(bank.observation).log_softmax(-1).flatten(1)
        scores: Tensor = table[:, (row * 4 + action).flatten()].view(64, -1, 20).sum(2)
        return scores

    torch.testing.assert_close(segment_scores(population, bank), gather(), rtol=1e-4, atol=1e-4)
    race(
        "64 members 8-64-64-4 on 2000 segments x 20 steps, 200 distinct observations",
        lambda: segment_scores(population, bank),
        gather,
        reference="table and index",
        target=1,
        rounds=9,
        number=5,
    )


def test_half_precision(race: Any, say: Any) -> None:
    """No target: it pays on processors that multiply bfloat16 in hardware, and only there."""
    population, bank = whole_population(4), continuous_bank(256, steps=8)
    margin, half = (
        scores[:, ::2] - scores[:, 1::2]
        for scores in (
            segment_scores(population, bank),
            segment_scores(population, bank, dtype=torch.bfloat16),
        )
    )
    differ = ((margin > 0) != (half > 0)).float().mean()
    error = (half - margin).std() / margin.std()
    say(f"bfloat16: {differ:.2%} of passes differ, error {error:.2%} of the margins' spread")
    race(
        "4 members in bfloat16 on 128 pairs x 2 x 8 steps",
        lambda: segment_scores(population, bank, dtype=torch.bfloat16),
        lambda: segment_scores(population, bank),
        reference="float32",
        target=0,
        rounds=3,
    )
