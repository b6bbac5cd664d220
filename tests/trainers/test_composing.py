"""Composed from files that are read once, a configuration is the one that Hydra composes."""

import pytest
from hydra import compose, initialize_config_module
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from popl_rl.trainers import composing
from popl_rl.trainers.composing import compose_settings
from popl_rl.trainers.typed import opened

GIVEN = {
    "nothing": [],
    "numbers and texts": ["seed=3", "run_dir='2026_01'", "env.max_steps=20", "logger=csv"],
    "choices": ["env=hidden_utility", "raters=cycle", "method=em", "method.em.groups=3"],
    "lists and mappings": [
        "raters.groups=[upper,lower]",
        "raters.shares=[0.5,0.5]",
        "env.mixture={random:1}",
        "env.mixture={explorer:0.5}",
    ],
    "new arguments": [
        "env.options.size=7",
        "+env.options.colour=red",
        "env.data_options={start: near}",
    ],
    "what is taken away": ["env.options.size=7", "~env.options.size"],
    "references": ["data.length=${env.max_steps}", "seed=${data.length}"],
    "nothing instead": ["data.load=null", "method.popl.epsilon=mad"],
}


def by_hydra(overrides, name="train"):
    with initialize_config_module("popl_rl.configs", version_base="1.3"):
        return compose(name, overrides=opened(overrides))


@pytest.mark.parametrize("overrides", GIVEN.values(), ids=GIVEN)
def test_what_is_composed_is_what_hydra_composes(overrides):
    for _ in range(2):
        found, wanted = compose_settings(overrides), by_hydra(overrides)
        assert found == wanted
        assert OmegaConf.to_yaml(found) == OmegaConf.to_yaml(wanted)
        assert OmegaConf.is_struct(found) == OmegaConf.is_struct(wanted)
        assert type(OmegaConf.to_object(found)) is type(OmegaConf.to_object(wanted))


@pytest.mark.parametrize(
    "override",
    ["sede=3", "method=nonsense", "seed=many", "seed=1,2", "~nothing", "+seed=3", "env.max_steps="],
)
def test_what_hydra_refuses_is_refused_in_its_words(override):
    told = []
    for composed in (compose_settings, by_hydra):
        with pytest.raises((HydraException, OmegaConfBaseException)) as refused:
            composed([override])
        told.append((type(refused.value), str(refused.value)))
    assert told[0] == told[1]


def test_configurations_are_of_their_own():
    one = compose_settings(["seed=3"])
    one.method.members = 7
    assert compose_settings(["seed=3"]) == by_hydra(["seed=3"])


def test_files_are_read_once(monkeypatch):
    compose_settings(["env=lava_gap", "seed=1"])
    monkeypatch.setattr(composing, "compose", None)
    assert compose_settings(["env=lava_gap", "seed=2"]).seed == 2
