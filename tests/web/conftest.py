"""Two policies that want opposite things, segments to ask about, and stores in a folder."""

import math

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from popl_rl.models.policies import PolicySpec
from popl_rl.models.policy_set import PolicySet
from popl_rl.models.population import Population


@pytest.fixture
def policies():
    """Policies 0 and 1 take action 0 with probability 9/10 and 1/10; the scores' scale is 1."""
    networks = []
    for bias in ([math.log(9), 0.0], [0.0, math.log(9)]):
        network = nn.Sequential(nn.Linear(1, 2))
        state = {"0.weight": torch.zeros(2, 1), "0.bias": torch.tensor(bias)}
        network.load_state_dict(state)
        networks.append(network)
    return PolicySet(Population(networks, PolicySpec(1, 2, True, ())), alpha=1.0)


@pytest.fixture
def steps():
    """Eight segments of one step: action 0 in those with an even number, 1 in the others."""
    action = (torch.arange(8) % 2).unsqueeze(1)
    return TensorDict({"observation": torch.ones(8, 1, 1), "action": action}, [8, 1])
