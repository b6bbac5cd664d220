"""Checks for people who write plug-ins, and a tiny environment to try things on.

From a shell::

    python -m popl_rl.testing env two_doors --with doors=3
    python -m popl_rl.testing rater my_raters.py:tender --env two_doors
    python -m popl_rl.testing features eyes.py:load --env lava_gap --with view=partial
    python -m popl_rl.testing selection my_rules.py:lucky_case
    python -m popl_rl.testing method my_method.py:NoisyLexicase --with noise=0.02
    python -m popl_rl.testing reader my_reader.py:read --data answers.csv --env two_doors

One line says what is wrong and what to do, with exit code 2, or that nothing is, with exit code 0.
Importing this package registers nothing.

One check for each kind of plug-in: ``environments`` (its parts in ``env_parts``),
``rater_functions``, ``feature_extractors``, ``selection_rules``, ``methods`` and ``readers``;
``plug_ins`` calls what is checked, ``tiny`` is the tiny environment, ``tiny_problem`` what methods
are tried on, and ``command`` the command line.
"""

from popl_rl.testing.environments import check_env
from popl_rl.testing.feature_extractors import check_features
from popl_rl.testing.methods import check_method
from popl_rl.testing.rater_functions import check_rater
from popl_rl.testing.readers import check_reader
from popl_rl.testing.selection_rules import check_selection
from popl_rl.testing.tiny import likes_left, likes_right, tiny_env

__all__ = [
    "check_env",
    "check_features",
    "check_method",
    "check_rater",
    "check_reader",
    "check_selection",
    "likes_left",
    "likes_right",
    "tiny_env",
]
