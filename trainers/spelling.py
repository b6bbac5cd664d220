"""What a person probably meant where Hydra finds no such setting or choice."""

import difflib
import re
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import Any, get_type_hints

from hydra.errors import MissingConfigException

__all__ = ["explained"]

#: Sections whose keys are arguments of a factory, which no schema lists.
_OPEN = ("env.options", "env.data_options", "env.mixture", "method.options")


def explained(error: Exception, schema: type) -> str:
    """The message of an error, with the nearest name where one was not found.

    Args:
        error: What Hydra raised, or anything else.
        schema: Dataclass of the command's settings.
    """
    text = str(error)
    unknown = re.match(r"Could not override '([\w.@/-]+)'", text)
    if unknown:
        name = unknown[1]
        text = f"Could not override {name!r}: there is no such setting."
        if name.startswith(tuple(f"{section}." for section in _OPEN)):
            return f"{text} Arguments of a factory are appended, as in +{name}=..."
        return f"{text}{_guess(name, list(_names(schema)))} --cfg job lists all settings."
    if isinstance(error, MissingConfigException) and error.missing_cfg_file and error.options:
        group, _, choice = error.missing_cfg_file.partition("/")
        known = [option for option in error.options if option != "__init__"]
        nested = [f"{one}/..." for one in known if one == "metaworld"]
        listed = ", ".join([*(one for one in known if one != "metaworld"), *nested])
        return f"unknown {group} {choice!r}.{_guess(choice, known)} Known: {listed}."
    return text


def _guess(name: str, known: list[str]) -> str:
    nearest = difflib.get_close_matches(name, known, n=1)
    if not nearest:  # perhaps the section was forgotten
        nearest = [one for one in known if one.endswith(f".{name}")][:1]
    return f" Did you mean {nearest[0]!r}?" if nearest else ""


def _names(schema: type) -> Iterator[str]:
    """Names of all settings, with dots."""
    hints: dict[str, Any] = get_type_hints(schema)
    for field in fields(schema):
        kind = hints[field.name]
        if is_dataclass(kind) and isinstance(kind, type):
            yield from (f"{field.name}.{name}" for name in _names(kind))
        else:
            yield field.name
