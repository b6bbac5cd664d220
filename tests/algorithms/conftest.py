"""Raters of groups on a ring, for methods that find groups."""

import pytest
import torch

from popl_rl.data.comparisons import Comparisons
from popl_rl.envs.hidden_utility import sample_states
from popl_rl.models.reward_functions import reward_bank
from popl_rl.models.scoring import case_values


@pytest.fixture(scope="session")
def ring():
    """``ring(groups)``: bank, comparisons and the group of each rater."""

    def make(groups, *, raters=12, answers=12, seed=0, apart=None):
        """Raters of groups on a ring, evenly or so far apart: bank, comparisons, each's group."""
        apart = 1 / groups if apart is None else apart
        generator = torch.Generator().manual_seed(seed)
        states = sample_states(400, generator=generator)
        group = torch.arange(raters * groups) % groups
        rater = torch.arange(len(group)).repeat_interleave(answers)
        pair = torch.randint(400, (len(rater), 2), generator=generator)
        value = states["observation"][:, 0, 0][pair] + (apart * group[rater]).unsqueeze(1)
        first = (value.remainder(1)[:, 0] > value.remainder(1)[:, 1]).long()
        row = torch.arange(len(rater))
        comparisons = Comparisons(pair[row, 1 - first], pair[row, first], rater, len(group))
        return reward_bank(states), comparisons, group

    return make


@pytest.fixture(scope="session")
def learn():
    """``learn(problem, population, weight, steps=...)``: weight of each answer to each member."""

    def train(problem, population, weight, *, steps):
        loss = problem.loss(population)
        optimizer = torch.optim.Adam(population.members.parameters(), lr=0.05)
        for _ in range(steps):
            losses = loss.pairs(problem.comparisons.preferred, problem.comparisons.other)
            optimizer.zero_grad()
            (losses * weight).mean(1).sum().backward()
            optimizer.step()

    return train


@pytest.fixture(scope="session")
def served():
    """``served(found, bank, comparisons, group)`` for each group."""

    def rate(found, bank, comparisons, group):
        """How right the best member is on the raters of each group."""
        values = case_values(found.margins(bank, comparisons) > 0, comparisons)
        return [float(values[:, group == one].mean(1).max()) for one in group.unique()]

    return rate
