from importlib.resources import files
from pathlib import Path

import pytest

from popl_rl.experiments.suites import load_suite, parse_suite

SUITES = files("popl_rl.configs.suites")
NAMES = sorted(entry.name[:-5] for entry in SUITES.iterdir() if entry.name.endswith(".yaml"))
SWEEP = {
    "overrides": ["env=gym"],
    "seeds": 3,
    "methods": {"popl": [], "mine": ["method=popl_published", "method.members=4"]},
    "scenarios": {
        "many": {"overrides": ["raters.count=90"], "at": {"raters": 90}},
        "base": {"overrides": [], "at": {"raters": 9, "kind": "plain"}},
        "few": {
            "overrides": ["method.members=2"],
            "at": {"raters": 1},
            "methods": ["mine"],
            "data_of": "base",
        },
        "odd": {"overrides": ["raters=minority"], "at": {"kind": "odd"}},
    },
}


def test_a_suite_is_read():
    suite = parse_suite("sweep", SWEEP)
    assert (suite.name, suite.seeds, suite.overrides) == ("sweep", 3, ("env=gym",))
    assert suite.methods == {"popl": (), "mine": ("method=popl_published", "method.members=4")}
    few = suite.scenarios["few"]
    assert (few.overrides, few.methods, few.data_of) == (("method.members=2",), ("mine",), "base")
    assert suite.scenarios["many"].methods == ("popl", "mine")
    assert suite.scenarios["many"].data_of is None


def test_scenarios_lie_on_axes_in_the_order_of_numbers_or_as_written():
    assert parse_suite("sweep", SWEEP).axes() == {
        "raters": {"few": 1, "base": 9, "many": 90},
        "kind": {"base": "plain", "odd": "odd"},
    }
    order = list(parse_suite("sweep", SWEEP).axes()["raters"])
    assert order == ["few", "base", "many"]


def test_methods_are_shown_in_the_suites_order_under_names_that_say_what_they_are():
    suite = parse_suite("sweep", SWEEP)
    pooled, oracle = ("pooled_cpl", ""), ("oracle", "")
    mine = [("mine", "posterior"), ("mine", "lexicase")]
    found = [pooled, mine[1], oracle, mine[0], ("popl", "posterior")]
    assert suite.ordered(found) == [("popl", "posterior"), *mine, pooled, oracle]
    assert suite.label("popl") == "popl"
    assert suite.label("mine", "lexicase") == "mine, by lexicase"
    assert suite.label("pooled_cpl") == "CPL on everybody's answers"


def test_a_scenario_may_be_a_list():
    suite = parse_suite("s", {"methods": {"popl": []}, "scenarios": {"a": ["raters=minority"]}})
    assert suite.scenarios["a"].overrides == ("raters=minority",)
    assert suite.seeds == 5


def changed(**changes):
    return {**SWEEP, **changes}


@pytest.mark.parametrize(
    ("definition", "message"),
    [
        ([1], r"the suite must be a mapping, got \[1\]"),
        (changed(method={}), r"the suite: unknown key 'method'. Did you mean 'methods'\? Known: "),
        (changed(methods={}), "methods must name at least one"),
        (changed(scenarios=None), "scenarios must be a mapping, got None"),
        (changed(seeds=0), "seeds must be a number of at least 1, got 0"),
        (changed(overrides="env=gym"), "overrides must be a list of overrides .*got 'env=gym'"),
        (changed(scenarios={"a/b": []}), "scenarios: 'a/b' does not do as a name"),
        (changed(scenarios={"a": None}), r"scenarios.a.overrides must be a list"),
        (changed(scenarios={"a": ["seed=3"]}), "scenarios.a.overrides: 'seed=3' is set by the"),
        (changed(overrides=["+hydra.job.name=a"]), "overrides: '.hydra.job.name=a' is set by the"),
        (changed(overrides=["data.load=a"]), "overrides: 'data.load=a' is set by the benchmark"),
        (
            changed(methods={"popl": ["raters=minority"]}),
            "methods.popl: 'raters=minority' would give methods different data",
        ),
        (
            changed(methods={"popl": ["evaluation.answers=1"]}),
            "methods.popl: 'evaluation.answers=1' would give methods different data or judges",
        ),
        (changed(methods={"oracle": []}), "methods.oracle has the name of other rows"),
        (
            changed(methods={"dpl_categorical": [], "popl": []}),
            "methods.dpl_categorical has the name of other rows",
        ),
        (
            changed(scenarios={"a": {"overides": []}}),
            "scenarios.a: unknown key 'overides'. Did you mean 'overrides'",
        ),
        (
            changed(scenarios={"a": {"methods": ["main"]}}),
            "scenarios.a.methods: unknown method 'main'. Did you mean 'mine'",
        ),
        (changed(scenarios={"a": {"methods": "mine"}}), "scenarios.a.methods must be a list"),
        (
            changed(scenarios={"a": {"at": {"raters": [1]}}}),
            r"scenarios.a.at.raters must be a number or a word, got \[1\]",
        ),
        (changed(scenarios={"a": {"at": 3}}), "scenarios.a.at must be a mapping, got 3"),
        (
            changed(scenarios={"one": [], "a": {"overrides": ["env=gym"], "data_of": "on"}}),
            "scenarios.a.data_of: unknown scenario 'on'. Did you mean 'one'",
        ),
        (
            changed(scenarios={"one": [], "a": {"overrides": ["env=gym"], "data_of": "one"}}),
            r"scenarios.a.data_of: .* \['env=gym'\] do nothing",
        ),
        (
            changed(
                scenarios={"one": [], "a": {"overrides": ["+method.a=1"], "data_of": "a"}},
            ),
            "scenarios.a.data_of must name a scenario that makes its own data",
        ),
        (
            changed(scenarios={"one": ["a=1", "b=1"], "two": ["b=1", "a=1"]}),
            "scenarios.two is the same as scenarios.one; keep one",
        ),
    ],
)
def test_what_is_wrong_with_a_suite_is_named(definition, message):
    with pytest.raises(ValueError, match=r"(?s)suite 'mine' has problems:.*" + message):
        parse_suite("mine", definition)


def test_all_problems_are_named_at_once():
    with pytest.raises(ValueError, match=r"(?s)seeds must be.*scenarios must be|scenarios.*seeds"):
        parse_suite("mine", changed(seeds=0, scenarios=3))


def test_names_of_settings_are_compared_whole():
    """``seeds`` is not ``seed``, ``data_options`` not ``data``."""
    scenarios = {"a": ["env.data_options.start=mixed", "seeds=1"]}
    suite = parse_suite("s", changed(scenarios=scenarios))
    assert suite.scenarios["a"].overrides[1] == "seeds=1"


def test_a_suite_of_the_package_or_a_file_of_ones_own(tmp_path):
    assert load_suite("two_doors", folder=SUITES).name == "two_doors"
    mine = tmp_path / "mine.yaml"
    mine.write_text("methods: {popl: []}\nscenarios: {a: []}\n")
    assert load_suite(str(mine), folder=SUITES).name == "mine"
    with pytest.raises(ValueError, match=r"unknown suite 'two_dors'\. Did you mean 'two_doors'"):
        load_suite("two_dors", folder=SUITES)
    with pytest.raises(
        ValueError, match=r"unknown suite .*none\.yaml.*Known: .*smoke, .*stateless"
    ):
        load_suite(str(tmp_path / "none.yaml"), folder=SUITES)


@pytest.mark.parametrize("text", ["a: [", "methods: {}\nmethods: {}\n"])
def test_a_file_that_is_no_yaml(tmp_path, text):
    (tmp_path / "mine.yaml").write_text(text)
    with pytest.raises(ValueError, match=r"mine\.yaml' is not valid YAML"):
        load_suite(str(tmp_path / "mine.yaml"), folder=SUITES)


def test_the_suites_of_the_package():
    assert {"smoke", "stateless", "sweeps", "two_doors"} <= set(NAMES)
    stateless = load_suite("stateless", folder=SUITES)
    assert {axis: list(points.values()) for axis, points in stateless.axes().items()} == {
        "population": [10, 30, 100, 300, 1000],
        "preferences": [208, 496, 2048],
        "flips": [0, 0.1, 0.2, 0.3, 0.4],
        "minority": [0.05, 0.1, 0.2, 0.5],
        "answers": [1, 5, 20, 50],
    }
    assert len(load_suite("two_doors", folder=SUITES).scenarios) == 6
    sweeps = load_suite("sweeps", folder=SUITES)
    assert {axis: list(points.values()) for axis, points in sweeps.axes().items()} == {
        "groups": [2, 3, 4],
        "minority": [5, 10, 20, 50],
        "mistakes": [0, 10, 20, 30],
        "rationality": ["always", "β = 10", "β = 3", "β = 1"],
        "answers": [5, 20, 80],
        "ids": ["with", "without"],
        "population": [50, 100, 500, 1000],
        "generations": [25, 50, 100, 200],
        "agreement": [38, 50, 60, 70, 80, 90],
    }


@pytest.mark.parametrize("name", NAMES)
def test_every_suite_explains_itself(name):
    first = Path(str(SUITES / f"{name}.yaml")).read_text().splitlines()[:2]
    assert all(line.startswith("# ") or line == "#" for line in first)
