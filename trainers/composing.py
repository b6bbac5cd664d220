"""What Hydra composes of overrides, whose files are read once for many configurations."""

import copy
from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from typing import Any

from hydra import compose, initialize_config_module
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from popl_rl.trainers.typed import opened

__all__ = ["compose_settings"]


def compose_settings(overrides: Sequence[str], *, name: str = "train") -> Any:
    """Compose a configuration as ``hydra.compose`` does, also inside of a Hydra job.

    Reading and merging the files takes a tenth of a second, which a benchmark of a thousand cells
    need not take for each of them: they choose among few files and change single settings.

    Args:
        overrides: As typed, such as ``"method=em"`` or ``"env.options.size=7"``.
        name: Of the configuration.

    Raises:
        HydraException: What Hydra finds wrong.
    """
    given = opened(overrides)
    if GlobalHydra.instance().is_initialized():  # inside of a Hydra job
        return _composed(name, given)
    with initialize_config_module("popl_rl.configs", version_base="1.3"):
        return _composed(name, given)


def _composed(name: str, given: Sequence[str]) -> Any:
    try:
        return _changed(name, given)
    except (HydraException, OmegaConfBaseException):
        return compose(name, overrides=list(given))  # which says it in its own words


def _changed(name: str, given: Sequence[str]) -> Any:
    """The chosen files with single settings changed as Hydra would, which it does last too."""
    parsed = OverridesParser.create().parse_overrides(list(given))
    if any(one.is_delete() or one.is_add() or one.is_sweep_override() for one in parsed):
        raise HydraException("left to Hydra")
    files_chosen = [one for one in parsed if _chooses_a_file(one)]
    path = GlobalHydra.instance().config_loader().get_search_path().get_path()
    chosen = (str(one.input_line) for one in files_chosen)
    config = copy.deepcopy(_of_files(name, str(path), *chosen))
    for one in parsed:
        if not _chooses_a_file(one):
            added = one.is_force_add()
            OmegaConf.update(config, one.key_or_group, one.value(), force_add=added)
    return config


@cache
def _of_files(name: str, _search_path: str, *chosen: str) -> Any:
    return compose(name, overrides=list(chosen))


def _chooses_a_file(override: Override) -> bool:
    group = override.key_or_group
    return "/" in group or override.package is not None or group in _groups()


@cache
def _groups() -> frozenset[str]:
    """Settings that stand for a file each."""
    return frozenset(one.name for one in files("popl_rl.configs").iterdir() if one.is_dir())
