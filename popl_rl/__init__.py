"""Pareto-optimal preference learning: one policy for every hidden group of raters.

Names are loaded when first used, so that importing the package is cheap.
"""

from importlib import import_module
from importlib.metadata import version as _version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from popl_rl.lexicase import lexicase_selection
    from popl_rl.policy_set import PolicySet
    from popl_rl.popl import POPL
    from popl_rl.population import Population
    from popl_rl.preferences import PreferenceCollector
    from popl_rl.raters import RaterGroup, Raters
    from popl_rl.registry import behaviour, env, rater

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
    "POPL": "popl",
    "PolicySet": "policy_set",
    "Population": "population",
    "PreferenceCollector": "preferences",
    "RaterGroup": "raters",
    "Raters": "raters",
    "behaviour": "registry",
    "env": "registry",
    "lexicase_selection": "lexicase",
    "rater": "registry",
}


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(import_module(f"popl_rl.{_HOME[name]}"), name)
    raise AttributeError(f"module 'popl_rl' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
