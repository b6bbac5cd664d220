"""The Adam of small tensors is torch's, to the bit."""

import pytest
import torch

from popl_rl.optim import adam, take_step

SHAPES = [(3, 8, 14), (3, 8), (513,), (1,), ()]


def pair(shapes=SHAPES, dtype=torch.float32, **options):
    """Two optimisers of equal parameters, and the parameters of each: torch's and ours."""
    generator = torch.Generator().manual_seed(0)
    start = [torch.randn(shape, generator=generator, dtype=dtype) for shape in shapes]
    both = [[one.clone().requires_grad_() for one in start] for _ in range(2)]
    makers = torch.optim.Adam, adam
    made = [make(own, lr=2e-3, **options) for make, own in zip(makers, both, strict=True)]
    return made, both


def descend(optimizers, parameters, *, steps=30, seed=1):
    """The same gradients, large and small, for both; the second tensor has none at first."""
    generator = torch.Generator().manual_seed(seed)
    for step in range(steps):
        for number, (one, other) in enumerate(zip(*parameters, strict=True)):
            size = 10.0 ** int(torch.randint(-6, 3, (), generator=generator))
            gradient = size * torch.randn(one.shape, generator=generator, dtype=one.dtype)
            missing = number == 1 and step < 7
            one.grad, other.grad = (None, None) if missing else (gradient, gradient.clone())
        for optimizer in optimizers:
            optimizer.step()


def assert_same(optimizers, parameters):
    for one, other in zip(*parameters, strict=True):
        assert torch.equal(one, other)
        states = [made.state[own] for made, own in zip(optimizers, (one, other), strict=True)]
        assert states[0].keys() == states[1].keys()
        for name, value in states[0].items():
            assert torch.equal(value, states[1][name])
            assert value.dtype == states[1][name].dtype


@pytest.mark.parametrize("options", [{}, {"betas": (0.5, 0.9), "eps": 1e-5}])
def test_steps_are_those_of_torch_to_the_bit(options):
    optimizers, parameters = pair(**options)
    assert optimizers[1].defaults["foreach"] is True
    schedules = [
        torch.optim.lr_scheduler.LambdaLR(one, lambda epoch: 1 / (1 + epoch)) for one in optimizers
    ]
    for seed in range(3):
        descend(optimizers, parameters, seed=seed)
        for schedule in schedules:
            schedule.step()
    assert_same(optimizers, parameters)


def test_states_of_one_are_loaded_into_the_other():
    optimizers, parameters = pair()
    descend(optimizers, parameters)
    states = [one.state_dict() for one in optimizers]
    for optimizer, state in zip(optimizers, reversed(states), strict=True):
        optimizer.load_state_dict(state)
    descend(optimizers, parameters, seed=2)
    assert_same(optimizers, parameters)


def test_what_is_large_is_left_to_torch():
    optimizers, _ = pair(shapes=[(2**16 + 1,), (1,)])
    assert optimizers[1].defaults["foreach"] is None


def test_a_step_is_one_of_backward_and_leaves_other_gradients_alone():
    optimizers, parameters = pair(shapes=[(3,), (2,)])
    elsewhere = torch.ones(3, requires_grad=True)
    for _ in range(3):
        one, other = ((elsewhere * own[0]).exp().sum() for own in parameters)
        optimizers[0].zero_grad()
        one.backward()
        optimizers[0].step()
        elsewhere.grad = None
        take_step(optimizers[1], other)
        assert elsewhere.grad is None
    assert_same(optimizers, parameters)
    assert parameters[1][1].grad is None, "it is not asked"
