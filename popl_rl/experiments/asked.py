"""Which groups were asked, kept beside their answers, and whether the groups at hand are the same.

Groups are numbers in the preferences. Under other names, or where a rater's function was changed,
each group would be measured by what another one wants, and nothing would look wrong.
"""

import json
from collections.abc import Sequence
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor

from popl_rl.keys import GROUP, PAIR, UTILITY
from popl_rl.storage import read_manifest, write_json

__all__ = ["check_asked", "write_groups"]

#: Beside saved preferences: names of the groups.
_ABOUT = "about.json"


def write_groups(path: Path, names: Sequence[str]) -> None:
    """Say in a folder of data which groups its raters are of."""
    write_json(path / _ABOUT, {"groups": list(names)})


def check_asked(
    load: Path, preferences: TensorDict, names: Sequence[str], segment_utility: Tensor | None
) -> None:
    """Raise unless preferences were given by these groups, in this order.

    Args:
        load: Folder that they are from.
        preferences: TensorDict ``[M]``; of people whose group nobody knows nothing is checked.
        names: Names of the groups at hand.
        segment_utility: Worth of each segment to each group, ``[G, N]``, which is compared with
            what it was to the raters; None where it is not known exactly.

    Raises:
        ValueError: If the groups or their order are others, or a group wants something else now.
    """
    if GROUP not in preferences.keys(True):
        return
    _check_names(load, names, numbered=1 + int(preferences[GROUP].max()))
    if segment_utility is None or UTILITY not in preferences.keys(True):
        return
    now = segment_utility[preferences[GROUP].unsqueeze(-1), preferences[PAIR]]
    # Machines add in different orders.
    differs = ~torch.isclose(now, preferences[UTILITY], rtol=1e-3, atol=1e-4).all(-1)
    if bool(differs.any()):
        changed = sorted({names[group] for group in preferences[GROUP][differs].tolist()})
        raise ValueError(
            f"what {', '.join(changed)} want is not what they wanted when the raters in {load} "
            f"were asked: {int(differs.sum())} of {len(differs)} answers told other utilities. "
            "Restore the raters' file, raters.label, raters.response and env.options as they were, "
            "or collect the data again"
        )


def _check_names(load: Path, names: Sequence[str], *, numbered: int) -> None:
    """Raise unless preferences were given by the groups of these names, in this order."""
    about = load / _ABOUT
    try:
        asked = json.loads(about.read_text(encoding="utf-8"))["groups"]
        asked = [str(name) for name in asked]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(
            f"{about} must say which groups the raters in {load} are of, and is not readable "
            f"({type(error).__name__}: {error}); data of earlier versions have no such file. "
            "Collect the data again, or, if raters.groups is what was asked then (see config.yaml "
            f"of that run), write it yourself: {json.dumps({'groups': list(names)})}"
        ) from error
    if numbered > len(asked):
        raise ValueError(
            f"{load} holds preferences of {numbered} groups, but {about} names {len(asked)}; the "
            "two do not belong together, collect the data again"
        )
    manifest = read_manifest(load / "preferences")
    kept = None if manifest is None else manifest["about"].get("groups")
    if kept is not None and kept != asked:
        raise ValueError(
            f"{about} names the groups [{', '.join(asked)}], but the raters in {load} are of "
            f"[{', '.join(kept)}], in this order; restore the file from a copy"
        )
    if asked == list(names):
        return
    what = "the same number of them in another order or by other names"
    if len(asked) != len(names):
        what = str(len(names))
    raise ValueError(
        f"{load} holds preferences of {len(asked)} groups, but raters.groups names {what}; name "
        f"the groups that were asked then, in that order: expected [{', '.join(asked)}], got "
        f"[{', '.join(names)}]"
    )
