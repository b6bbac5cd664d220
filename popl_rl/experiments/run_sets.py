"""The sets in a run's folder: written with the id of the run, and read if they are its own."""

import shutil
from collections.abc import Mapping
from pathlib import Path

from popl_rl.experiments.run_manifest import check_own, run_id
from popl_rl.models.hypothesis_set import HypothesisSet
from popl_rl.models.policy_set import PolicySet
from popl_rl.models.reward_set import RewardSet
from popl_rl.models.sets import load_set

__all__ = ["load_found_set", "load_own_set", "save_anew"]


def save_anew(
    found: HypothesisSet, path: Path, run_dir: Path, *, digests: Mapping[str, str] | None = None
) -> None:
    """Save a set in the place of what a killed run may have left.

    Args:
        found: The set.
        path: Its folder.
        run_dir: Folder of the run, whose id it keeps.
        digests: Of what it was trained on, which it keeps.
    """
    run = run_id(run_dir)
    provenance = {**(digests or {}), **({} if run is None else {"run": run})}
    shutil.rmtree(path, ignore_errors=True)
    found.save(path, provenance=provenance)


def load_found_set(run_dir: Path) -> HypothesisSet:
    """Read what a run has found: its reward functions, or its policies where there are none.

    Raises:
        FileNotFoundError: If it has found no set yet.
        ValueError: If the set is damaged, was changed, or is of another run.
    """
    is_reward = (run_dir / RewardSet.folder).is_dir()
    return load_own_set(run_dir, (RewardSet if is_reward else PolicySet).folder)


def load_own_set(run_dir: Path, folder: str) -> HypothesisSet:
    """Read a set of a run.

    Raises:
        FileNotFoundError: If there is none.
        ValueError: If it is damaged, was changed, or is of another run.
    """
    found = load_set(run_dir / folder)
    check_own(run_dir, found.provenance, run_dir / folder)
    return found
