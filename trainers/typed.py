"""What was typed, so that Hydra reads it as it was meant."""

import re
from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from types import UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import OverrideParseException

from popl_rl.config import OPEN

__all__ = ["as_typed", "opened"]

#: Groups of settings that are chosen by a name, each with a choice.
_GROUPS = {"env": "two_doors", "raters": "two_groups", "method": "popl", "logger": "csv"}
#: Of groups in which something of one's own may be named, where its reference goes.
_OWN = {
    "env": "env=custom env.factory={}",
    "raters": "raters=own raters.groups=[{}]",
    "method": "method.factory={}",
}
#: A name, quoted or not.
_NAME = re.compile(r"""['"]?[\w./-]*[A-Za-z][\w./-]*['"]?""")
#: A sweep with a function.
_SWEEP = re.compile(r"\w+\(.*\)")


def opened(overrides: Sequence[str]) -> list[str]:
    """Overrides whose arguments of a factory may be new, with the plus that Hydra wants there.

    Args:
        overrides: As typed, such as ``"env.options.size=7"`` or ``"env.mixture={gait:1}"``.
    """
    starts = tuple(f"{section}{end}" for section in OPEN for end in (".", "={"))
    # Behaviours may be called go/left, or meant by a pattern: no names of settings to Hydra.
    named = [
        re.sub(r"^(\+*env\.mixture)\.([^=]*[^\w.=][^=]*)=(.*)$", r"\1={\2:\3}", one)
        for one in overrides
    ]
    return [f"++{one}" if one.startswith(starts) else one for one in named]


def as_typed(arguments: Sequence[str], schema: type) -> list[str]:
    """Quote the values of text settings that would come out as other text.

    ``run_dir=2026_01`` would be the folder ``202601``, because underscores may divide the digits of
    a number, and ``run_dir=1e3`` the folder ``1000.0``.

    Args:
        arguments: Of the command.
        schema: Dataclass of its settings.

    Returns:
        The arguments for Hydra. Values that are lists, mappings or sweeps with functions are left
        as they are; each value of a sweep ``a,b`` is looked at by itself.

    Raises:
        ValueError: If a group of settings is given something else than the name of a choice.
    """
    texts = set(_texts(schema))
    parser = OverridesParser.create()
    kept = []
    for argument in arguments:
        key, equals, value = argument.partition("=")
        if key in _GROUPS and equals and not _is_choice(value):
            raise ValueError(
                f"{key} must be a choice by its name, as in {key}={_GROUPS[key]}, got {argument}; "
                f"{_own(key, value)}"
            )
        if equals and key.lstrip("+") in texts:
            argument = f"{key}={','.join(_quoted(part, parser) for part in value.split(','))}"
        kept.append(argument)
    return kept


def _own(key: str, value: str) -> str:
    """How to say what somebody may have meant who gave a group something else than a name."""
    if key in _OWN and ":" in value and value[0] not in "{[":
        return f"one of yours is named as in {_OWN[key].format(value)}"
    return f"settings of it are given one by one, as in {key}.name=value"


def _is_choice(value: str) -> bool:
    """Whether a value names a choice of a group, or several for a sweep."""
    named = all(_NAME.fullmatch(part) for part in value.split(","))
    return named or _SWEEP.fullmatch(value) is not None


def _quoted(value: str, parser: OverridesParser) -> str:
    try:
        read = parser.parse_override(f"x={value}").value()
    except OverrideParseException:
        return value  # Hydra says what is wrong with it
    changed = isinstance(read, (int, float)) and str(read) != value
    return f"'{value}'" if changed else value


def _texts(schema: type, path: str = "") -> list[str]:
    """Names of all settings that are text, with dots."""
    found = []
    hints: dict[str, Any] = get_type_hints(schema)
    for field in fields(schema):
        kind, name = hints[field.name], f"{path}{field.name}"
        if is_dataclass(kind) and isinstance(kind, type):
            found += _texts(kind, f"{name}.")
        elif kind is str or (get_origin(kind) in (Union, UnionType) and str in get_args(kind)):
            found.append(name)
    return found
