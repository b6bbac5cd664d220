"""The files of a saved set: tensors, and JSON that says what they are and knows their digests."""

import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, cast

import torch
from tensordict import TensorDictBase

from popl_rl.manifest import read_sealed, sealed
from popl_rl.models.policies import PolicySpec, build_network
from popl_rl.models.population import Population
from popl_rl.models.reward_functions import RewardSpec
from popl_rl.storage import (
    load_tensordict,
    read_manifest,
    save_tensordict,
    write_json,
    written_beside,
)

__all__ = ["VERSION", "read_about", "read_population", "write_set"]

VERSION = 2
"""Of the format."""


def write_set(
    path: Path,
    about: Mapping[str, Any],
    members: TensorDictBase,
    *,
    more: Callable[[Path], None],
) -> None:
    """Write a set; nothing is left half-written.

    Args:
        path: The folder to be.
        about: What the members are; its ``format`` is ``popl_rl.<kind>/2``, and ``<kind>.json`` the
            name of the file.
        members: Their weights.
        more: Writes further folders of tensors into the folder that it is called with.

    Raises:
        FileExistsError: If ``path`` exists.
        OSError: If there is no room.
    """
    kind = about["format"].removeprefix("popl_rl.").partition("/")[0]
    with written_beside(path) as beside:
        save_tensordict(members, beside / "members")
        more(beside)
        # The digests of the tensors tie them to what is said about them.
        digests = {
            folder.name: cast("dict[str, str]", read_manifest(folder))["digest"]
            for folder in sorted(beside.iterdir())
        }
        write_json(beside / f"{kind}.json", sealed({**about, "digests": digests}))


def read_about(path: Path) -> dict[str, Any]:
    """Read what the members of a set are.

    A set of an earlier version has no digests, which is told: its ``digests`` are empty.

    Args:
        path: The JSON file.

    Raises:
        ValueError: If it is damaged, was changed, or is of another format.
        KeyError: If it says no format.
    """
    about = read_sealed(path, cure="train again or restore the folder")
    is_old = about.pop("seal", "") is None
    kind = f"popl_rl.{path.stem}"
    if is_old and about["format"] == f"{kind}/1":
        warnings.warn(
            f"{path.parent} was saved by an earlier version, without digests: whether it is "
            "damaged or was mixed up cannot be told",
            stacklevel=3,
        )
        return {**about, "digests": {}}
    if is_old or about["format"] != f"{kind}/{VERSION}":
        raise ValueError(f"unknown format {about['format']!r}, expected {kind}/{VERSION}")
    return about


def read_population(
    path: Path, about: Mapping[str, Any], kind: type[PolicySpec] | type[RewardSpec]
) -> Population:
    """Read the members of a set.

    Args:
        path: The folder.
        about: What ``read_about`` found.
        kind: What they are.

    Raises:
        ValueError: If tensors are damaged or missing, or not those that belong here.
        KeyError, TypeError, RuntimeError: If sizes make no sense.
    """
    sizes: dict[str, Any] = {  # JSON knows no tuples
        name: tuple(value) if isinstance(value, list) else value
        for name, value in about["spec"].items()
    }
    spec = kind(**sizes)
    generator = torch.Generator().manual_seed(0)
    networks = [build_network(spec, generator=generator) for _ in range(about["members"])]
    population = Population(networks, spec, evolve=about["evolve"])
    trunk = {name: torch.tensor(value) for name, value in about["trunk"].items()}
    population.trunk.load_state_dict(trunk)
    members = load_tensordict(path / "members", digest=about["digests"].get("members"))
    expected = population.members.data
    for key in expected.keys(True, True):
        if members[key].shape != expected[key].shape:
            raise ValueError(f"{key} has shape {tuple(members[key].shape)}")
        if not members[key].isfinite().all():
            raise ValueError(f"{key} has numbers that are NaN or infinite")
    expected.update_(members)
    return population
