"""Sets whose files were cut, exchanged or changed are refused, whatever it was."""

import json
import math
import shutil

import pytest
import torch

from popl_rl.manifest import sealed
from popl_rl.models.policies import PolicySpec
from popl_rl.models.policy_set import PolicySet
from popl_rl.models.population import Population


def saved_set(path, *, evolve="head", hidden=(4, 3), seed=3):
    generator = torch.Generator().manual_seed(seed)
    spec = PolicySpec(3, 2, True, hidden, 0.3)
    population = Population.create(spec, 3, evolve=evolve, generator=generator)
    PolicySet(population, alpha=0.1, discount=0.97).save(path)


def edit(**changes):
    """Write policy_set.json anew: replace entries, or remove them if the new value is None."""

    def damage(path):
        file = path / "policy_set.json"
        about = json.loads(file.read_text())
        about.update(changes, seal=None)
        file.write_text(json.dumps(sealed({k: v for k, v in about.items() if v is not None})))

    return damage


def cut_json(path):
    file = path / "policy_set.json"
    file.write_text(file.read_text()[:-10])


def without_a_seal(path):
    file = path / "policy_set.json"
    about = json.loads(file.read_text())
    del about["seal"]
    file.write_text(json.dumps(about))


def changed_by_hand(path):
    file = path / "policy_set.json"
    text = file.read_text()
    assert '"alpha": 0.1' in text
    file.write_text(text.replace('"alpha": 0.1', '"alpha": 0.2'))


def members_of_another_training(path):
    shutil.rmtree(path / "members")
    saved_set(path.parent / "other", seed=4)
    shutil.move(path.parent / "other" / "members", path / "members")


def list_json(path):
    (path / "policy_set.json").write_text("[1, 2]")


def cut_members(path):
    file = next((path / "members").rglob("*weight*.memmap"))
    file.write_bytes(file.read_bytes()[:-4])


def no_members(path):
    shutil.rmtree(path / "members")


def members_of_another_set(path):
    shutil.rmtree(path / "members")
    saved_set(path.parent / "other", hidden=(4, 2))
    shutil.move(path.parent / "other" / "members", path / "members")


def members_of_whole_networks(path):
    shutil.rmtree(path / "members")
    saved_set(path.parent / "other", evolve="all")
    shutil.move(path.parent / "other" / "members", path / "members")


SPEC = {"observation_dim": 3, "action_dim": 2, "discrete": True, "hidden": [4, 3]}


@pytest.mark.parametrize(
    "damage",
    [
        cut_json,
        list_json,
        without_a_seal,
        changed_by_hand,
        cut_members,
        no_members,
        members_of_another_set,
        members_of_another_training,
        members_of_whole_networks,
        edit(format="another/1"),
        edit(format=None),
        edit(alpha=None),
        edit(alpha="much"),
        edit(alpha=math.nan),
        edit(discount=None),
        edit(origin=None),
        edit(members=4),
        edit(members="three"),
        edit(evolve="some"),
        edit(spec={**SPEC, "observation_dim": 0}),
        edit(spec={**SPEC, "colour": "red"}),
        edit(spec={**SPEC, "hidden": [5, 3]}),
        edit(spec=None),
        edit(trunk=[1, 2]),
        edit(trunk={}),
    ],
)
def test_a_damaged_set_is_refused(tmp_path, damage):
    saved_set(tmp_path / "set")
    damage(tmp_path / "set")
    message = r"set is not readable as a policy set \(.*train again or restore the folder"
    with pytest.raises(ValueError, match=f"(?s){message}"):
        PolicySet.load(tmp_path / "set")
