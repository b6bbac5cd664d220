"""Everything that is shipped keeps what the checks of plug-ins ask for."""

from importlib.resources import files

import pytest
import torch

from popl_rl import registry
from popl_rl.config import plain
from popl_rl.experiments.builders import build_method, build_problem
from popl_rl.models.policies import PolicySpec
from popl_rl.selection.rules import SELECTIONS
from popl_rl.testing import check_env, check_method, check_rater, check_selection

ENVS = registry.names("env")
RATERS = registry.names("rater")
METHODS = sorted(
    path.name.removesuffix(".yaml")
    for path in files("popl_rl.configs.method").iterdir()
    if path.name.endswith(".yaml")
)
#: Small, whatever the method.
QUICK = [
    "method.members=4",
    "method.generations=3",
    "method.hidden=[6]",
    "method.training.steps=6",
    "method.training.batch_size=16",
    "method.popl.specialist_steps=3",
    "method.popl.pooled_steps=4",
    "method.popl.warm_up=3",
    "method.refinement.steps=20",
    "method.em.groups=2",
    "method.kmeans.groups=2",
]


def home(rater):
    """An environment that is defined beside the rater; None if there is none."""
    module = registry.resolve("rater", rater).__module__
    found = [name for name in ENVS if registry.resolve("env", name).__module__ == module]
    return found[0] if found else None


def test_there_is_something_to_check():
    assert ENVS
    assert RATERS


@pytest.mark.parametrize("name", ENVS)
def test_environments(name):
    check_env(name)


#: Raters whose functions stand for a family of groups, as one of them.
WITH_ARGUMENTS = {"ring": "ring(1,3)", "blend": "blend(0.3)", "visits": "visits(2)"}


#: Raters of environments that are defined elsewhere. A blend is of two coordinates.
AWAY = {"blend": ("hidden_plane", {})}
AWAY |= {name: ("gymnasium:make", {"id": "CartPole-v1"}) for name in ("left", "right")}


@pytest.mark.parametrize("name", RATERS)
def test_raters(name):
    environment, arguments = AWAY.get(name, (home(name), {}))
    assert environment is not None, f"no environment is defined beside rater {name!r}"
    check_rater(WITH_ARGUMENTS.get(name, name), environment, **arguments)


@pytest.mark.parametrize("name", ["lexicase", *SELECTIONS])
def test_selections(name):
    check_selection(name)


@pytest.fixture(scope="session")
def method_settings(config_of):
    """Settings of a method by its name in ``configs/method``, and small."""
    return lambda name: plain(config_of(f"method={name}", *QUICK)).method


# In a tiny problem the largest number of members may be the best.
@pytest.mark.filterwarnings("default:the largest number of members")
@pytest.mark.parametrize("name", METHODS)
def test_methods(name, method_settings):
    """Among it that one seed gives one result to the bit, and that resuming changes no bit."""
    method = method_settings(name)
    sections = {part: getattr(method, part) for part in method.sections() if part != "training"}
    kinds = {"cases": method.cases, "evolve": method.evolve}
    check_method(method.factory, **kinds, sections=sections, **method.options)


@pytest.mark.parametrize("name", METHODS)
def test_methods_of_other_seeds_find_something_else(name, method_settings, bank, comparisons):
    method = method_settings(name)
    problem = build_problem(method, PolicySpec(5, 2, True, (6,)), bank, comparisons)

    def learn(seed):
        generator = torch.Generator().manual_seed(seed)
        built = build_method(method, problem, num_groups=2, generator=generator)
        built.step()
        return list(built.population.members.data.values(True, True))

    assert not any(map(torch.equal, learn(0), learn(1)))
