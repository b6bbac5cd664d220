"""Small things that many tests need; the world is the line of five cells of popl_rl.testing."""

import gc

import pytest
import torch
from hydra._internal.hydra import Hydra
from hydra.core.hydra_config import HydraConfig
from hypothesis import settings

import popl_rl.trainers.run_benchmark  # noqa: F401 - it makes the schemas known to Hydra
from popl_rl.algorithms.problem import Problem
from popl_rl.config import MethodConfig, Training
from popl_rl.data.bank import SegmentBank
from popl_rl.data.behaviours import random_behaviour
from popl_rl.data.comparisons import Comparisons
from popl_rl.data.segments import collect_segments, segment_buffer
from popl_rl.experiments.builders import build_method, build_problem
from popl_rl.models.policies import PolicySpec
from popl_rl.processes import Workers
from popl_rl.raters.collector import collect_preferences
from popl_rl.raters.groups import make_groups
from popl_rl.raters.people import Raters
from popl_rl.testing import likes_left, likes_right, tiny_env
from popl_rl.trainers.composing import compose_settings
from popl_rl.trainers.train_popl import run

gc.disable()  # until everything is imported, of which nothing is garbage

# How long an example takes says how busy the machine is.
settings.register_profile("popl_rl", deadline=None)
settings.load_profile("popl_rl")

# Small tensors are slower on several threads, and tests share their cores.
torch.set_num_threads(1)

# A run of the whole trainer in a few seconds, long enough for oracles to beat random actions.
TINY = [
    "evaluation.figures=false",
    "env.max_steps=20",
    "method.generations=3",
    "method.members=4",
    "method.training.steps=100",
    "method.training.batch_size=64",
    "method.training.learning_rate=0.02",
    "method.refinement.steps=20",
    "method.hidden=[8]",
    "data.segments=200",
    "data.length=6",
    "raters.count=8",
    "method.training.bc=1",  # beside a few dozen answers 40 would be nearly all
    "raters.answers=10",
    "evaluation.episodes=40",
    "evaluation.new_raters=2",
    "evaluation.curve=[1,5]",
    "evaluation.pairs=200",
    "evaluation.learning_curve=0",
    "logger=csv",
]


def pytest_addoption(parser):
    parser.addoption(
        "--update-golden",
        action="store_true",
        help="rewrite tests/golden/*.json with what the tests now get",
    )


def pytest_collection_finish():
    """Leave what was imported out of every garbage collection: a million objects that stay."""
    gc.freeze()
    gc.enable()


def pytest_runtest_teardown():
    """What one test has typed is not what the next one has."""
    HydraConfig.instance().cfg = None


@pytest.fixture(autouse=True, scope="session")
def commands_are_composed_once():
    """Hydra composes all of a command's settings first to see whether they hold ``hydra.mode``.

    No file of ours sets it. Commands in processes of their own are left as they are.
    """
    original = Hydra.get_mode

    def get_mode(self, config_name, overrides):
        asked = any("hydra.mode" in one for one in overrides)
        return original(self, config_name, overrides) if asked else None

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Hydra, "get_mode", get_mode)
        yield


@pytest.fixture(scope="session")
def tiny():
    """Overrides of ``popl-train`` for a run of a few seconds; the first is for two doors alone."""
    return ["env.options.size=7", *TINY]


@pytest.fixture(scope="session")
def workers():
    """Two processes that all tests share, because starting them takes seconds."""
    with Workers(2) as both:
        yield both


@pytest.fixture(scope="session")
def config_of():
    """What Hydra makes of overrides."""
    return lambda *overrides, name="train": compose_settings(overrides, name=name)


@pytest.fixture(scope="session")
def finished(tmp_path_factory, config_of, tiny):
    """The tiny run with its pictures, for tests that change nothing in its folder."""
    folder = tmp_path_factory.mktemp("finished") / "runs" / "mine"
    return run(config_of(*tiny, "evaluation.figures=true", f"run_dir={folder}"))


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(0)


@pytest.fixture
def env():
    return tiny_env(max_steps=8)


@pytest.fixture(scope="session")
def _walks():
    return collect_segments(
        lambda: tiny_env(max_steps=8),
        {"random": random_behaviour(tiny_env().action_space)},
        num_segments=40,
        length=4,
        generator=torch.Generator().manual_seed(0),
        num_envs=8,
    )


@pytest.fixture
def segments(_walks):
    """40 random walks of 4 steps."""
    return _walks.clone()


@pytest.fixture
def bank(segments):
    return SegmentBank.from_segments(segments)


@pytest.fixture
def groups():
    """Raters who want to be at the left end, and raters who want to be at the right end."""
    return make_groups([likes_left, likes_right], label="return")


@pytest.fixture
def preferences(segments, groups):
    """15 answers of each of 8 raters, the first four of group 0."""
    raters = Raters(groups, torch.tensor([0] * 4 + [1] * 4))
    buffer = collect_preferences(
        segment_buffer(segments),
        raters,
        answers_per_rater=15,
        generator=torch.Generator().manual_seed(1),
    )
    return buffer[:].exclude("index")


@pytest.fixture(scope="session")
def learner():
    """Builds a method from settings by name, such as ``training__steps=20``, as a run does."""

    def make(spec, bank, comparisons, *, clone=None, generator=None, num_groups=2, **settings):
        config = MethodConfig()
        for path, value in settings.items():
            *sections, name = path.split("__")
            section = config
            for part in sections:
                section = getattr(section, part)
            assert hasattr(section, name), path
            setattr(section, name, value)
        problem = build_problem(config, spec, bank, comparisons, clone=clone)
        generator = torch.Generator().manual_seed(0) if generator is None else generator
        return build_method(config, problem, num_groups=num_groups, generator=generator)

    return make


@pytest.fixture
def problem(bank, comparisons):
    """Policies with a hidden layer of 8 on the line of five cells, trained for a moment."""
    training = Training(steps=20, batch_size=16)
    spec = PolicySpec(5, 2, True, (8,))
    return Problem(spec, bank, comparisons, training, members=6, generations=10)


@pytest.fixture
def comparisons(preferences):
    """The strict preferences, a case for each rater."""
    return Comparisons.from_preferences(preferences, cases="rater")
