"""What people type: a thousand malformed settings, and random ones that may be well."""

import random
import shutil
import time
import warnings
from dataclasses import fields, is_dataclass
from typing import get_args, get_origin, get_type_hints

import pytest
from hydra import compose, initialize_config_module

from popl_rl.config import Config
from popl_rl.trainers.command import USER_ERRORS, prepare
from popl_rl.trainers.spelling import explained
from popl_rl.trainers.typed import as_typed, opened

pytestmark = [pytest.mark.campaign, pytest.mark.timeout(1800)]

#: What no setting of a kind may be.
WRONG = {
    int: ["many", "1.5", "[1]", "{a:1}", "inf", "nan", f"-{10**30}", f"{10**30}", "true", "''"],
    float: ["much", "nan", "-inf", "1e400", "-1e308", "[1]", "{a:1}", "''", "true_"],
    bool: ["maybe", "[true]", "{a:1}", "nein", "''"],
    str: ["[a]", "{a:1}"],
    list: ["x", "5", "{a:1}", "[[1]]", "[{a:1}]", "null"],
    dict: ["x", "5", "[1]", "true"],
}
#: Infinite rationality always tells the truth.
RIGHT = {("raters.response.rationality", "1e400"), ("raters.response.skip", "-1e308")}
#: Lists and mappings that may be null.
NULLABLE = {"raters.shares", "method.reads", "env.mixture"}


def settings(schema=Config, path=""):
    """Name, kind and whether it may be null of every setting."""
    hints = get_type_hints(schema)
    for field in fields(schema):
        kind, name = hints[field.name], f"{path}{field.name}"
        options = get_args(kind) if type(None) in get_args(kind) else (kind,)
        kind = next(option for option in options if option is not type(None))
        if is_dataclass(kind):
            yield name, "section", False
            yield from settings(kind, f"{name}.")
        else:
            yield name, get_origin(kind) or kind, len(options) > 1


def malformed():
    """Overrides that are wrong, each with a word that the answer must have."""
    for name, kind, nullable in settings():
        if kind == "section":
            yield from ((f"{name}={value}", name.split(".")[0]) for value in ("5", "[1]"))
            continue
        last = name.rpartition(".")[2]
        for value in WRONG[kind]:
            if (name, value) in RIGHT or (value == "null" and name in NULLABLE):
                continue
            yield f"{name}={value}", last
        if not nullable and kind is not list:
            yield f"{name}=null", last
        yield f"{name}s_=1", f"{last}s_"
        yield f"+{name}_more=1", f"{last}_more"
        yield f"~{name}", last


def answer(override):
    """What ``popl-train`` says of an override; None if it would go on."""
    try:
        given = opened(as_typed([override], Config))
        prepare(compose("train", overrides=given), given)
    except USER_ERRORS as error:
        return explained(error, Config)
    return None


def test_malformed_settings_are_refused_by_name(part):
    cases = sorted(set(malformed()))
    assert len(cases) >= 1000
    wrong, slowest = [], 0.0
    with initialize_config_module("popl_rl.configs", version_base="1.3"):
        for override, word in part(cases):
            started = time.monotonic()
            said = answer(override)
            slowest = max(slowest, time.monotonic() - started)
            if said is None or word.lower() not in said.lower():
                wrong.append((override, said))
    assert wrong == []
    assert slowest < 20


#: Values of settings, most of them well by themselves, to be drawn together.
DRAWN = {
    "env": ["two_doors", "hidden_utility", "goal_grid"],
    "raters": ["two_groups", "three_groups", "minority", "identity", "cycle", "goals_4"],
    "method": [
        "popl",
        "popl_niches",
        "popl_published",
        "cpl",
        "multi_cpl",
        "em",
        "vpl",
        "lore",
        "kmeans",
    ],
    "method.cases": ["rater", "preference"],
    "method.ties": ["drop", "count"],
    "method.learns": ["auto", "policy", "reward"],
    "method.evolve": ["all", "head", "code"],
    "method.hidden": ["[]", "[4]", "[4,4]"],
    "method.members": ["1", "2", "5"],
    "method.generations": ["1", "3"],
    "method.training.alpha": ["0.01", "1000", "1e-30"],
    "method.training.learning_rate": ["1e-9", "0.1", "10"],
    "method.training.conservatism": ["1", "1e-9"],
    "method.popl.epsilon": ["mad", "null", "0", "1e30"],
    "method.popl.selection": ["lexicase", "tournament", "random", "best_sum"],
    "raters.count": ["1", "2", "7"],
    "raters.answers": ["1", "3"],
    "raters.label": ["regret", "return"],
    "raters.response.mistake": ["0.5", "1"],
    "raters.response.tie": ["0.01", "1e9"],
    "raters.response.skip": ["null", "1e9"],
    "raters.response.rationality": ["1e-9", "5"],
    "data.segments": ["2", "3", "70"],
    "data.length": ["1", "20", "21"],
    "evaluation.baselines": ["true", "false"],
    "evaluation.reference": ["random", "clone", "others"],
    "evaluation.optimiser": ["auto", "plan"],
    "evaluation.curve": ["[]", "[1,9]"],
    "evaluation.menu": ["2", "70"],
    "evaluation.history": ["0", "1"],
    "evaluation.greedy": ["true"],
    "env.success": ["''", "nope"],
    "env.mixture": ["null"],
    "seed": ["0", str(10**18)],
}
#: Settings of ``TINY`` that only methods of POPL's kind read.
POPL = ("method.refinement", "method.popl")


def drawn(number, tiny):
    """A few settings of ``DRAWN``, by a number, and the tiny ones that go with them."""
    draw = random.Random(number)
    names = draw.sample(sorted(DRAWN), draw.randint(1, 5))
    given = [f"{name}={draw.choice(DRAWN[name])}" for name in names]
    if any(one.startswith("env=") and one != "env=two_doors" for one in given):
        tiny = tiny[1:]
    if any(one.startswith("method=") and one != "method=popl" for one in given):
        tiny = [one for one in tiny if not one.startswith(POPL)]
    if "method.evolve=code" in given:
        given.append("method.clone.steps=3")
    return given, tiny


def fault_of(outcome, has_report):
    """What is wrong with how a command ended; None if nothing is."""
    if outcome.code == 0:
        return None if has_report else "exit code 0 without a report"
    if outcome.code != 2:
        return f"exit code {outcome.code}"
    if "error:" not in outcome.text or "Traceback" in outcome.text:
        return "no reason"
    return "refused late" if has_report else None


def test_random_settings_are_refused_or_run_to_their_report(part, train, tiny_settings, tmp_path):
    ends, faults, codes = time.monotonic() + 900, [], []
    for number in part(list(range(100))):
        if time.monotonic() > ends:
            break
        overrides, tiny = drawn(number, tiny_settings)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                outcome = train(*overrides, "run_dir=run", tiny=tiny)
        except Exception as error:
            faults.append((overrides, repr(error)))
        else:
            fault = fault_of(outcome, (tmp_path / "run" / "report.md").is_file())
            codes.append(outcome.code)
            if fault is not None or outcome.seconds > 120:
                faults.append((overrides, fault, outcome))
        shutil.rmtree(tmp_path / "run", ignore_errors=True)
    assert faults == []
    assert 0 in codes
