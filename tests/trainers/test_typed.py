"""What is typed: read as it was meant, or refused with what was expected and a cure."""

import pytest
from omegaconf import OmegaConf

from popl_rl.config import CHANGEABLE, Config, changed, changing_nothing, fixed, plain
from popl_rl.experiments.steps import open_run
from popl_rl.trainers.command import USER_ERRORS
from popl_rl.trainers.spelling import explained
from popl_rl.trainers.typed import as_typed


def refusal(config_of, *overrides):
    with pytest.raises(USER_ERRORS) as caught:
        plain(config_of(*overrides))
    return explained(caught.value, Config)


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("data.segments=many", "data.segments must be a whole number such as 4000, got data.seg"),
        ("data.segments=null", "data.segments must be a whole number such as 4000"),
        ("seed=1.5", "seed must be a whole number such as 0, got seed=1.5"),
        ("evaluation.greedy=maybe", "evaluation.greedy must be true or false, got"),
        ("raters.shares=[a,b]", "raters.shares must be a list in brackets"),
        ("raters.shares=[a,b]", "of entries that are each a number or null, got"),
        ("method.hidden=8", "of entries that are each a whole number, got method.hidden=8"),
        ("env.mixture=[1]", "env.mixture must be a mapping in braces"),
        ("method.training=null", "part by part, as in method.training.alpha=0.25, got"),
        ("~data.segments", "data.segments must be a whole number such as 4000, got ~data.seg"),
        ("data.segments=[1", "data.segments=[1 cannot be read as name=value"),
        ("run_dir=${nowhere}", "Interpolation key 'nowhere' not found"),
        ("+data.nonsense=1", "there is no such setting as data.nonsense; what is appended"),
        ("+nonsense.more=1", "there is no such setting as nonsense; what is appended"),
    ],
)
def test_what_does_not_fit_is_told_with_reason_and_cure(config_of, override, said):
    assert said in refusal(config_of, override)


def test_arguments_of_a_factory_are_appended(config_of):
    config = plain(config_of("+env.options.colour=red", "+method.options.noise=0.1"))
    assert config.env.options["colour"] == "red"
    assert config.method.options == {"noise": 0.1}


@pytest.mark.parametrize(
    ("typed", "kept"),
    [
        ("run_dir=2026_01", "run_dir='2026_01'"),
        ("run_dir=1e3", "run_dir='1e3'"),
        ("run_dir=true", "run_dir='true'"),
        ("run_dir=2026_01,2026_02", "run_dir='2026_01','2026_02'"),
        ("logger.project=007", "logger.project=007"),
        ("run_dir=2026", "run_dir=2026"),
        ("run_dir=runs/mine", "run_dir=runs/mine"),
        ("run_dir=null", "run_dir=null"),
        ("seed=1_0", "seed=1_0"),
        ("method.popl.epsilon=0.25", "method.popl.epsilon=0.25"),
        ("raters.groups=[a,b]", "raters.groups=[a,b]"),
        ("-m", "-m"),
    ],
)
def test_text_stays_as_it_was_typed(config_of, typed, kept):
    assert as_typed([typed], Config) == [kept]
    if typed in ("run_dir=2026_01", "run_dir=true"):
        assert config_of(kept).run_dir == typed.partition("=")[2]


def test_empty_mappings_change_nothing_and_are_refused():
    (problem,) = changing_nothing(["env.mixture={}", "env.options={size:7}"])
    assert problem == (
        "env.mixture={} changes nothing, because mappings are merged: give null for equal shares"
    )
    (problem,) = changing_nothing(["env.options={ }"])
    assert problem.endswith("delete single entries, as in ~env.options.name")


def test_beside_resume_only_what_changes_no_result():
    allowed = ["resume=x", "threads=2", "logger=csv", "logger.project=a", "evaluation.animate=true"]
    assert fixed([*allowed, "seed=1", "+env.options.a=1", "loggers=2", "method=em"]) == [
        "seed",
        "env.options.a",
        "loggers",
        "method",
    ]
    assert changed(allowed) == ["threads", "logger", "evaluation.animate"]
    assert set(changed(allowed)) < set(CHANGEABLE)


def test_a_resumed_run_takes_what_may_change_and_keeps_the_rest(config_of, tiny, tmp_path):
    first = plain(config_of(*tiny, f"run_dir={tmp_path / 'run'}", "seed=3", "threads=1"))
    with open_run(first, command=["popl-train"]):
        pass
    typed = [f"resume={tmp_path / 'run'}", "checkpoint_interval=4"]
    again = plain(config_of(*typed))
    with open_run(again, command=["popl-train"], given=typed) as (config, run_dir, _):
        pass
    assert run_dir == tmp_path / "run"
    assert config.checkpoint_interval == 4
    assert config.seed == 3
    kept = OmegaConf.load(run_dir / "config.yaml")
    assert kept.checkpoint_interval == first.checkpoint_interval


@pytest.mark.parametrize("typed", ["env=5", "raters=[1]", "method={name:popl}", "logger=3,4"])
def test_a_group_of_settings_is_chosen_by_name(typed):
    with pytest.raises(ValueError, match=rf"{typed[:3]}\w* must be a choice by its name, as in"):
        as_typed([typed], Config)


@pytest.mark.parametrize(
    ("typed", "cure"),
    [
        ("env=line.py:Line", r"as in env=custom env\.factory=line\.py:Line$"),
        ("raters=mine.py:left", r"as in raters=own raters\.groups=\[mine\.py:left\]$"),
        ("method=mine.py:Noisy", r"as in method\.factory=mine\.py:Noisy$"),
        ("method={name:popl}", r"as in method\.name=value$"),
    ],
)
def test_a_reference_in_the_place_of_a_choice_is_told_where_it_goes(typed, cure):
    with pytest.raises(ValueError, match=cure):
        as_typed([typed], Config)


@pytest.mark.parametrize(
    "typed", ["env=metaworld/any", "method='popl'", "raters=a,b", "method=glob(popl*)"]
)
def test_choices_and_sweeps_of_them_are_names(typed):
    assert as_typed([typed], Config) == [typed]
