import math
from pathlib import Path

import pytest

import popl_rl.configs
from popl_rl.config import (
    Config,
    EnvConfig,
    LoggerConfig,
    MethodConfig,
    RatersConfig,
    parse_epsilon,
    plain,
    unread,
    validate,
)

FOLDER = Path(popl_rl.configs.__file__).parent
SCHEMAS = {
    "env": EnvConfig,
    "raters": RatersConfig,
    "method": MethodConfig,
    "logger": LoggerConfig,
}


def valid(**changes):
    """A valid configuration, but for the changes; dots of a path are written as ``__``."""
    config = Config(raters=RatersConfig(groups=["upper", "lower"]))
    for path, value in changes.items():
        *sections, name = path.split("__")
        section = config
        for part in sections:
            section = getattr(section, part)
        assert hasattr(section, name)
        setattr(section, name, value)
    return config


def problems_of(config):
    with pytest.raises(ValueError, match="the configuration has problems:\n") as caught:
        validate(config)
    first, *problems = str(caught.value).split("\n  ")
    assert first == "the configuration has problems:"
    return problems


def at_least_one(*paths):
    return [
        (path, value, f"{path.replace('__', '.')} must be at least 1, got {value}")
        for path in paths
        for value in (0, -3)
    ]


CASES = [
    *at_least_one(
        "env__max_steps",
        "raters__count",
        "raters__answers",
        "data__length",
        "evaluation__episodes",
        "evaluation__new_raters",
        "evaluation__answers",
        "evaluation__pairs",
        "evaluation__curve_members",
        "method__generations",
        "method__training__steps",
        "method__training__batch_size",
        "method__mixture__mixtures",
        "method__mixture__generations",
        "method__popl__tournament",
        "method__em__groups",
        "method__vpl__latent",
        "method__lore__bases",
        "method__clone__code_dim",
        "method__refinement__most",
        "threads",
        "checkpoint_interval",
    ),
    ("env__mixture", {"a": 0.5, "b": 0.4},
     "env.mixture must be non-negative shares that sum to 1, got {'a': 0.5, 'b': 0.4}"),
    ("env__mixture", {"a": 1.5, "b": -0.5},
     "env.mixture must be non-negative shares that sum to 1, got {'a': 1.5, 'b': -0.5}"),
    ("workers", "some", "workers must be auto, or a number from 1 to 1024, got 'some'"),
    ("workers", "0", "workers must be auto, or a number from 1 to 1024, got '0'"),
    ("raters__groups", [],
     "raters.groups must be one or more rater references, such as [my_raters.py:fast,"
     "my_raters.py:careful], unless people's answers are in "
     "data.load, got []"),
    ("raters__groups", ["upper", "upper"],
     "raters.groups must be different groups, got ['upper', 'upper']"),
    ("raters__shares", [1.0], "raters.shares must be one number per group (2), got [1.0]"),
    ("raters__shares", [0.5, 0.6],
     "raters.shares must be non-negative and sum to 1, got [0.5, 0.6]"),
    ("raters__shares", [-0.5, 1.5],
     "raters.shares must be non-negative and sum to 1, got [-0.5, 1.5]"),
    ("raters__label", "taste", "raters.label must be regret or return, got 'taste'"),
    ("raters__response__rationality", -1.0,
     "raters.response.rationality must be positive, got -1.0"),
    ("raters__response__mistake", 1.5, "raters.response.mistake must be in [0, 1], got 1.5"),
    ("raters__response__myopia", 0.0, "raters.response.myopia must be in (0, 1], got 0.0"),
    ("raters__response__myopia", math.nan, "raters.response.myopia must be in (0, 1], got nan"),
    ("raters__response__tie", -0.1, "raters.response.tie must be at least 0, got -0.1"),
    ("data__segments", 1, "data.segments must be at least 2, to compare, got 1"),
    ("data__load", "/no/such/run/data",
     "data.load must be the folder 'data' of an earlier run, or other data with data.reader, got "
     "'/no/such/run/data'"),
    ("data__reader", "my.py:read", "data.reader must be null without data.load, got 'my.py:read'"),
    ("method__factory", "", "method.factory must be a reference of a method, got ''"),
    ("method__reads", ["training", "magic"],
     "method.reads must be sections out of training, popl, refinement, niches, mixture, clone, em, "
     "vpl, lore, kmeans, got ['magic']"),
    ("method__lore__learning_rate", 0.0, "method.lore.learning_rate must be positive, got 0.0"),
    ("method__kmeans__most", 1, "method.kmeans.most must be at least 2, got 1"),
    ("method__popl__selection", "",
     "method.popl.selection must be lexicase or a reference, got ''"),
    ("method__vpl__kl", -0.5, "method.vpl.kl must be at least 0, got -0.5"),
    ("method__training__bc", -1.0, "method.training.bc must be at least 0, got -1.0"),
    ("method__training__slip", 0.5, "method.training.slip must be in [0, 0.5), got 0.5"),
    ("method__refinement__folds", 1, "method.refinement.folds must be at least 2, got 1"),
    ("method__mixture__held_out", 1.0, "method.mixture.held_out must be in [0, 1), got 1.0"),
    ("method__cases", "group", "method.cases must be rater or preference, got 'group'"),
    ("method__popl__variation", "cosmic",
     "method.popl.variation must be auto, gradient, gaussian, mixtures, got 'cosmic'"),
    ("method__popl__variation", "gaussian",
     "method.evolve must be head for Gaussian variation, got 'all'"),
    ("method__evolve", "some", "method.evolve must be all, head, code, got 'some'"),
    ("method__members", 1, "method.members must be at least 2, to select among, got 1"),
    ("method__hidden", [64, 0], "method.hidden must be positive, got [64, 0]"),
    ("method__popl__epsilon", "some",
     "method.popl.epsilon must be mad, a number of at least 0, or null, got 'some'"),
    ("method__training__alpha", 0.0, "method.training.alpha must be positive, got 0.0"),
    ("method__training__alpha", math.nan, "method.training.alpha must be positive, got nan"),
    ("method__training__conservatism", 1.1,
     "method.training.conservatism must be in (0, 1], got 1.1"),
    ("method__training__conservatism", 0.0,
     "method.training.conservatism must be in (0, 1], got 0.0"),
    ("method__training__discount", 0.0, "method.training.discount must be in (0, 1], got 0.0"),
    ("method__training__discount", 1.01, "method.training.discount must be in (0, 1], got 1.01"),
    ("method__popl__warm_up", -1, "method.popl.warm_up must be at least 0, got -1"),
    ("method__training__learning_rate", 0.0,
     "method.training.learning_rate must be positive, got 0.0"),
    ("method__popl__mutation_std", -0.1, "method.popl.mutation_std must be positive, got -0.1"),
    ("evaluation__curve", [5, 0], "evaluation.curve must be numbers of at least 1, got [5, 0]"),
    ("evaluation__history", -1, "evaluation.history must be at least 0, got -1"),
    ("logger__name", "paper", "logger.name must be wandb or csv, got 'paper'"),
    ("raters__shares", [1.0, 0.0],
     "raters.shares must be positive: leave out of raters.groups whom nobody belongs to, got "
     "[1.0, 0.0]"),
    ("raters__count", 1,
     "raters.count must be at least one for each group (2), because a group that gives no strict "
     "answer has no oracle: ask more raters, or set evaluation.baselines=false, got 1"),
    ("raters__response__tie", math.inf,
     "raters.response.tie must be at most 1.79769e+308, got inf"),
    ("raters__response__skip", math.nan,
     "raters.response.skip must be a finite number, or null, got nan"),
    ("method__training__alpha", 1e30, "method.training.alpha must be at most 1000, got 1e+30"),
    ("method__training__learning_rate", math.inf,
     "method.training.learning_rate must be at most 10, got inf"),
    ("method__popl__epsilon", "inf",
     "method.popl.epsilon must be mad, a number of at least 0, or null, got 'inf'"),
    ("method__generations", 10**12, "method.generations must be at most 1e+08, got 1000000000000"),
    ("method__hidden", [10**9],
     "method.hidden must be at most 100 layers of at most 1e+05 units, got [1000000000]"),
    ("evaluation__curve", [10**9],
     "evaluation.curve must be numbers of at most 1000000, got [1000000000]"),
    ("evaluation__baselines_from", "/",
     "evaluation.baselines_from must be the folder 'baselines' of an earlier run, got '/'"),
    ("device", "gpu", "device must be cpu, cuda, or one of them, as cuda:1, got 'gpu'"),
    ("seed", 2**64, "seed must be in 0..1000000000000000000, got 18446744073709551616"),
    ("data__seed", -1, "data.seed must be in 0..1000000000000000000, got -1"),
    ("run_dir", "", "run_dir must be a folder, or null, got ''"),
]  # fmt: skip


@pytest.mark.parametrize(("path", "value", "message"), CASES)
def test_a_problem_is_named_with_what_was_expected_and_what_came(path, value, message):
    assert message in problems_of(valid(**{path: value}))


def test_several_problems_are_reported_together():
    config = valid(
        method__cases="group",
        method__training__alpha=-1.0,
        raters__count=0,
        logger__name="paper",
        evaluation__baselines=False,
    )
    assert problems_of(config) == [
        "raters.count must be at least 1, got 0",
        "method.cases must be rater or preference, got 'group'",
        "method.training.alpha must be positive, got -1.0",
        "logger.name must be wandb or csv, got 'paper'",
    ]


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"raters__shares": [0.9, 0.1]},
        {"raters__shares": [1 / 3, 2 / 3]},
        {"env__mixture": {"planner/*": 0.5, "explorer": 0.5}},
        {"method__popl__variation": "gaussian", "method__evolve": "head"},
        {"method__hidden": []},
        {"method__popl__epsilon": None},
        {"method__popl__epsilon": "0.25"},
        {"method__popl__warm_up": 0, "evaluation__history": 0},
        {"raters__response__rationality": math.inf, "raters__response__mistake": 1.0},
    ],
)
def test_valid_configurations_pass(changes):
    validate(valid(**changes))


@pytest.mark.parametrize(
    "changes", [{"method__cases": "preference"}, {"method__popl__variation": "mixtures"}]
)
def test_style_codes_need_rater_ids(changes):
    (problem,) = problems_of(valid(method__evolve="code", **changes))
    assert problem == "method.evolve must be all without rater ids, got 'code'"


def test_a_method_that_lives_on_ids_is_refused_without_them(config_of):
    config = config_of("method=vpl", "method.cases=preference")
    (problem,) = problems_of(config)
    assert problem == (
        "method.cases must be rater, because it reads what one rater said, got 'preference'"
    )


READERS = {"popl": ["training", "popl"], "em": ["training", "em"]}


def test_settings_that_the_method_does_not_read_are_refused_with_who_does():
    method = MethodConfig()
    given = ["method.em.groups=3", "method.popl.epsilon=0", "seed=1", "method.members=4"]
    (problem,) = unread(given, method, READERS)
    assert problem == (
        "method.em.groups is not read by method 'popl', which reads training, popl, refinement, "
        "mixture; it is read by em"
    )
    (problem,) = unread(["+method.vpl.kl=1"], method, READERS)
    assert problem.endswith("it is read by no known method")


def test_a_foreign_method_reads_the_recipe_unless_it_says_more(config_of):
    own = ["method.factory=mine.py:Mine", "method.name=mine"]
    method = plain(config_of(*own)).method
    assert method.sections() == ["training"]
    [problem] = unread(["method.popl.tournament=3"], method, {"popl": ["training", "popl"]})
    assert "not read by method 'mine', which reads training; it is read by popl" in problem
    more = plain(config_of(*own, "method.reads=[training,vpl]")).method
    assert more.sections() == ["training", "vpl"]
    assert plain(config_of()).method.sections() == ["training", "popl", "refinement", "mixture"]


def test_settings_of_a_clone_are_for_style_codes():
    (problem,) = unread(["method.clone.steps=3"], MethodConfig(), READERS)
    assert problem == "method.clone.steps is read with method.evolve=code alone, got all"
    assert unread(["method.clone.steps=3"], MethodConfig(evolve="code"), READERS) == []


def test_a_folder_with_segments_can_be_loaded(tmp_path):
    (tmp_path / "segments").mkdir()
    validate(valid(data__load=str(tmp_path)))


@pytest.mark.parametrize(
    ("epsilon", "expected"),
    [(None, None), ("mad", "mad"), ("0.5", 0.5), (0.5, 0.5), ("0", 0.0), (1, 1.0)],
)
def test_epsilon_is_read(epsilon, expected):
    assert parse_epsilon(epsilon) == expected


@pytest.mark.parametrize("epsilon", ["", "MAD", "-0.1", -0.1, "nan", math.nan])
def test_epsilon_refuses(epsilon):
    message = "method.popl.epsilon must be mad, a number of at least 0, or null, got"
    with pytest.raises(ValueError, match=message):
        parse_epsilon(epsilon)


CHOICES = sorted(
    f"{group}={path.relative_to(FOLDER / group).with_suffix('').as_posix()}"
    for group in ("env", "raters", "method", "recipe", "logger")
    for path in (FOLDER / group).rglob("*.yaml")
)


@pytest.mark.parametrize("choice", CHOICES)
def test_every_choice_fits_its_schema_and_is_valid(choice, config_of, tmp_path):
    config = config_of(choice)
    if choice == "raters=people":
        with pytest.raises(ValueError, match=r"unless people's answers are in data\.load"):
            validate(config)
        (tmp_path / "segments").mkdir()
        config.data.load = str(tmp_path)
    must_be_given = {
        "env=gym": ("id", "CartPole-v1"),
        "env=custom": ("factory", "my_env.py:make"),
    }
    if choice in must_be_given:
        name, value = must_be_given[choice]
        with pytest.raises(ValueError, match=rf"env\.{name} must be"):
            validate(config)
        config.env[name] = value
    if choice in (*must_be_given, "raters=own"):
        with pytest.raises(ValueError, match=r"^[^\n]*\n  raters\.groups must be [^\n]*$"):
            validate(config)
        config.raters.groups = ["my_env.py:mine"]
    validate(config)


STUDIES = sorted(path.stem for path in (FOLDER / "study").glob("*.yaml"))


@pytest.mark.parametrize("study", STUDIES)
def test_every_study_fits_the_schema_of_people(study, config_of, tmp_path):
    (tmp_path / "segments").mkdir()
    config = config_of(f"study={study}", f"data.load={tmp_path}", name="people")
    validate(config)
    assert config.method.refinement.rewards
    assert list(config.raters.groups) == []


def test_an_environment_can_name_raters_of_its_own(config_of):
    assert config_of("env=hidden_utility").raters.groups == ["zeroed", "doubled"]
    assert len(config_of("env=hidden_utility", "raters=cycle").raters.groups) == 3


def test_values_outrank_choices_whatever_their_order(config_of):
    """A suite's overrides of a scenario come before those of a method."""
    config = config_of("method.em.groups=3", "method=em")
    assert (config.method.name, config.method.em.groups) == ("em", 3)
    assert config_of("method=em").method.em.groups is None


def test_a_method_outranks_an_environment(config_of):
    config = config_of("env=hidden_utility", "method=popl_published")
    assert (config.method.members, config.method.generations) == (100, 100)


@pytest.mark.parametrize(
    ("raters", "count", "answers"),
    [("ring_4", 80, 16), ("ring_32", 640, 16), ("continuum", 300, 8), ("identity", 128, 16)],
)
def test_raters_say_how_many_they_are_whatever_their_environment(config_of, raters, count, answers):
    config = config_of("env=hidden_utility", f"raters={raters}")
    assert (config.raters.count, config.raters.answers) == (count, answers)


@pytest.mark.parametrize(
    ("env", "own"),
    [
        ("metaworld/any", {"hidden": [128, 128]}),
        ("hopper", {"beta": 0.0001}),
        ("half_cheetah", {"beta": 0.0001}),
        ("dynamic_obstacles", {"beta": 0.0001}),
    ],
)
def test_a_recipe_is_that_of_the_environments_it_was_tuned_on(config_of, env, own):
    """Members of one's own environment are style codes by one word."""
    shared = config_of("env=gym", "recipe=style_codes").method
    assert (shared.evolve, shared.training.steps, shared.training.conservatism) == ("code", 96, 1)
    shared.hidden = own.get("hidden", shared.hidden)
    shared.clone.beta = own.get("beta", shared.clone.beta)
    assert config_of(f"env={env}").method == shared


def test_a_method_outranks_a_recipe(config_of):
    config = config_of("recipe=style_codes", "method=popl_published")
    assert (config.method.evolve, config.method.generations) == ("head", 100)
