"""Pareto-optimal preference learning: one policy for every hidden group of raters.

Names are loaded when first used, so that importing the package is cheap.
"""

from importlib import import_module
from importlib.metadata import version as _version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from popl_rl.algorithms.popl import POPL
    from popl_rl.models.policy_set import PolicySet
    from popl_rl.models.population import Population
    from popl_rl.raters.collector import PreferenceCollector
    from popl_rl.raters.groups import RaterGroup
    from popl_rl.raters.people import Raters
    from popl_rl.registry import behaviour, env, rater
    from popl_rl.selection.lexicase import lexicase_selection

__all__ = [
    "POPL",
    "PolicySet",
    "Population",
    "PreferenceCollector",
    "RaterGroup",
    "Raters",
    "behaviour",
    "env",
    "lexicase_selection",
    "rater",
]

__version__ = _version("popl_rl")

_HOME = {
    "POPL": "algorithms.popl",
    "PolicySet": "models.policy_set",
    "Population": "models.population",
    "PreferenceCollector": "raters.collector",
    "RaterGroup": "raters.groups",
    "Raters": "raters.people",
    "behaviour": "registry",
    "env": "registry",
    "lexicase_selection": "selection.lexicase",
    "rater": "registry",
}


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(import_module(f"popl_rl.{_HOME[name]}"), name)
    raise AttributeError(f"module 'popl_rl' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
