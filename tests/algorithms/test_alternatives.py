"""What POPL is compared with, where members are style codes."""

import pytest
import torch

from popl_rl.config import MethodConfig
from popl_rl.experiments.builders import build_popl, final_set
from popl_rl.models.policies import PolicySpec
from popl_rl.models.style_codes import train_clone
from popl_rl.models.style_population import StyledPopulation

SPEC = PolicySpec(5, 2, True, (6,))


@pytest.fixture
def clone(bank, generator):
    return train_clone(SPEC, bank, steps=5, batch_size=8, looks=2, generator=generator)


def build(algorithm, bank, comparisons, clone):
    config = MethodConfig(
        algorithm=algorithm, evolve="code", members=4, generations=2, steps=2, batch_size=16
    )
    generator = torch.Generator().manual_seed(0)
    return build_popl(config, SPEC, bank, comparisons, clone=clone, generator=generator)


@pytest.mark.parametrize(("algorithm", "members"), [("cpl", 1), ("multi_cpl", 4), ("em", 4)])
def test_codes_are_trained_and_the_clone_is_not(algorithm, members, bank, comparisons, clone):
    before = [value.clone() for value in clone.network.state_dict().values()]
    popl = build(algorithm, bank, comparisons, clone)
    codes = popl.population.members.data["code"].clone()
    popl.step()
    assert isinstance(popl.population, StyledPopulation)
    assert len(popl.population) == members
    assert not torch.equal(popl.population.members.data["code"], codes)
    assert all(map(torch.equal, before, clone.network.state_dict().values()))
    assert len(final_set(popl)) >= 1


def test_vpl_has_a_code_of_its_own(bank, comparisons, clone):
    with pytest.raises(ValueError, match=r"method\.evolve must be all for method\.algorithm=vpl"):
        build("vpl", bank, comparisons, clone)
