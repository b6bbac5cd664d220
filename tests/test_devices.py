"""Whatever learns, serves and judges does so on a GPU as on the processor.

The bodies are the same for both; without CUDA those of the GPU skip.
"""

import math

import pytest
import torch

from popl_rl.data.behaviours import random_behaviour
from popl_rl.evaluation.measures import roll_out
from popl_rl.experiments.builders import build_method, build_problem
from popl_rl.models.policies import PolicySpec
from popl_rl.models.policy_set import PolicySet
from popl_rl.models.reward_functions import RewardSpec
from popl_rl.models.style_codes import train_clone
from popl_rl.randomness import stream
from popl_rl.testing import tiny_env
from popl_rl.trainers.train_popl import run

CUDA = pytest.param(
    "cuda",
    marks=[
        pytest.mark.gpu,
        pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA"),
    ],
)
QUICK = (
    "method.members=4",
    "method.generations=2",
    "method.training.steps=8",
    "method.training.batch_size=16",
    "method.refinement.steps=10",
    "method.hidden=[8]",
)
METHODS = {
    **{
        name: [f"method={name}"]
        for name in (
            *("popl", "popl_published", "popl_nsga2", "popl_tournament", "popl_best_sum"),
            *("popl_random", "cpl", "multi_cpl", "em", "em_chosen", "vpl", "lore", "kmeans"),
        )
    },
    "popl_niches": ["method=popl_niches", "method.niches.specialists=8"],
    "preference cases": ["method.cases=preference"],
    "heads": ["method.evolve=head"],
    "style codes": ["method.evolve=code"],
    "reward functions": ["method.learns=reward"],
}


# Other tests have methods learn on the processor, and sooner.
@pytest.fixture(params=[pytest.param("cpu", marks=pytest.mark.slow), CUDA])
def device(request):
    return request.param


@pytest.fixture
def build(config_of, segments, comparisons, device):
    """Builds a method as a run on a device does."""

    def make(*overrides):
        config = config_of(*QUICK, *overrides).method
        is_reward = config.learns == "reward"
        spec = RewardSpec(5, 2, (8,)) if is_reward else PolicySpec(5, 2, True, (8,))
        bank = spec.bank(segments).to(device)
        clone = None
        if config.evolve == "code":
            clone = train_clone(
                spec, bank, steps=10, batch_size=16, generator=stream(0, "clone", device)
            )
        problem = build_problem(config, spec, bank, comparisons.to(device), clone=clone)
        generator = stream(0, "learner", device)
        return problem, build_method(config, problem, num_groups=2, generator=generator)

    return make


@pytest.mark.filterwarnings("default:the largest number of members")  # a tiny run has few
@pytest.mark.parametrize("name", METHODS)
def test_methods_learn_where_the_segments_are(build, segments, preferences, device, name, tmp_path):
    problem, method = build(*METHODS[name])
    for _ in range(2):
        assert math.isfinite(method.step()["worst_rater_accuracy"])
    again = build(*METHODS[name])[1]
    again.load_state_dict(method.state_dict())
    found = method.result()
    for value in found.population.plain().state_dict().values():
        assert value.device.type == device
        assert value.isfinite().all()
    assert again.generation == method.generation == 2

    # Whoever is served hands over tensors of the processor.
    answers = preferences[:6]
    choice = found.cater(segments, answers)
    assert choice.weights.device.type == "cpu"
    lexicase = found.cater(
        segments, answers, method="lexicase", generator=torch.Generator().manual_seed(0)
    )
    assert 0 <= lexicase.member < len(found)
    assert 0 <= found.fair(segments, preferences) < len(found)
    assert 1 <= len(found.distinct(problem.bank, problem.comparisons)) <= len(found)
    assert found.effective_number(problem.bank, problem.comparisons) >= 1
    found.save(tmp_path / "set")
    kept = type(found).load(tmp_path / "set")
    assert torch.allclose(
        kept.margins(segments, problem.comparisons.to("cpu")),
        found.margins(segments, problem.comparisons).cpu(),
        atol=1e-4,
    )


@pytest.mark.parametrize("device", ["cpu", CUDA], indirect=True)
def test_policies_act_from_any_device(build, device):
    found = build()[1].result()
    assert isinstance(found, PolicySet)
    episodes = roll_out(tiny_env, found, episodes=3, max_steps=6, seed=0)
    assert all(value.device.type == "cpu" for value in episodes.values(True, True))
    by_chance = roll_out(
        tiny_env,
        None,
        episodes=3,
        max_steps=6,
        seed=0,
        random_action=random_behaviour(tiny_env().action_space),
    )
    assert set(by_chance.keys(True, True)) == set(episodes.keys(True, True))


@pytest.mark.parametrize("device", ["cpu", CUDA], indirect=True)
def test_likelihoods_and_losses_are_those_of_the_processor(build, device):
    problem, method = build()
    population = method.population
    likelihood = problem.likelihood(problem.scores(population))
    index = torch.arange(20, device=device)
    # The likelihood knows no prior.
    loss = problem.loss(population, cloning=False)
    losses = loss.answers(problem.comparisons, index)
    assert likelihood.device.type == losses.device.type == device
    torch.testing.assert_close(losses.mean(1), -likelihood[:, :20].mean(1), rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("overrides", [(), ("method.learns=reward",), ("method.evolve=code",)])
def test_a_whole_run(config_of, tiny, tmp_path, device, overrides):
    result = run(config_of(*tiny, *overrides, f"device={device}", f"run_dir={tmp_path / 'run'}"))
    assert (result.run_dir / "report.md").is_file()
    assert PolicySet.is_at(result.run_dir / "policies") or overrides == ("method.learns=reward",)
    assert result.board.results.value.notna().any()
