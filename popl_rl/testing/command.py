"""The command ``python -m popl_rl.testing``."""

import argparse
import ast
import logging
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

from popl_rl.testing.environments import check_env
from popl_rl.testing.feature_extractors import check_features
from popl_rl.testing.methods import check_method
from popl_rl.testing.rater_functions import check_rater
from popl_rl.testing.readers import check_reader
from popl_rl.testing.selection_rules import check_selection

__all__ = ["main"]

#: What ``--with`` is given to, by kind.
_RECEIVERS = {
    "env": "the environment, as in doors=3",
    "rater": "the environment, as in doors=3",
    "features": "the environment, as in view=partial",
    "selection": "the rule, as in size=2",
    "method": "the method, as method.options are",
    "reader": "the environment, as in doors=3",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Check a plug-in from the command line; return 0 if all is well, 2 with the fault on stderr.

    Args:
        argv: Arguments; None takes those of the process.
    """
    given = _parser().parse_args(argv)
    arguments = dict(given.arguments)
    logging.getLogger("torchrl").setLevel(logging.WARNING)  # TorchRL sets its own when imported
    try:
        with warnings.catch_warnings():
            warnings.showwarning = cast("Any", _show)
            _check(given, arguments)
    except (TypeError, ValueError) as error:
        sys.stderr.write(f"{' '.join(str(error).split())}\n")
        return 2
    sys.stdout.write(f"{given.kind} {given.reference}: all checks passed\n")
    return 0


def _check(given: argparse.Namespace, arguments: dict[str, Any]) -> None:
    if given.kind == "env":
        check_env(given.reference, **arguments)
    elif given.kind == "rater":
        check_rater(given.reference, given.env, **arguments)
    elif given.kind == "features":
        check_features(given.reference, given.env, **arguments)
    elif given.kind == "selection":
        check_selection(given.reference, **arguments)
    elif given.kind == "method":
        kinds: dict[str, Any] = {"cases": given.cases, "evolve": given.evolve}
        check_method(given.reference, learns=cast("Any", given.learns), **kinds, **arguments)
    else:
        check_reader(given.reference, given.data, given.env, **arguments)


def _show(message: Warning | str, *_: Any) -> None:
    """A warning as a line of its own, without the place in the library that gave it."""
    sys.stderr.write(f"warning: {' '.join(str(message).split())}\n")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser("python -m popl_rl.testing", description=main.__doc__)
    kinds = parser.add_subparsers(dest="kind", required=True)
    for kind, receiver in _RECEIVERS.items():
        sub = kinds.add_parser(kind)
        sub.add_argument("reference", help="a name, package.module:attr or path/file.py:attr")
        sub.add_argument(
            "--with",
            dest="arguments",
            nargs="+",
            type=_argument,
            default=[],
            metavar="KEY=VALUE",
            help=f"arguments of {receiver}",
        )
    rater, method, reader = (kinds.choices[kind] for kind in ("rater", "method", "reader"))
    kinds.choices["features"].add_argument(
        "--env", required=True, help="environment whose observations are read"
    )
    rater.add_argument("--env", help="environment whose segments are judged")
    method.add_argument("--cases", default="rater", choices=("rater", "preference"))
    method.add_argument("--evolve", default="all", choices=("all", "head"))
    method.add_argument("--learns", default="policy", choices=("policy", "reward"))
    reader.add_argument("--data", required=True, type=Path, help="file or folder that it reads")
    reader.add_argument("--env", help="environment whose observations and actions these are")
    return parser


def _argument(text: str) -> tuple[str, Any]:
    key, equals, value = text.partition("=")
    if not equals:
        raise argparse.ArgumentTypeError(f"{text!r} must look like doors=3")
    try:
        return key, ast.literal_eval(value)
    except (ValueError, SyntaxError):
        return key, value
