"""What Hydra's errors mean: what a person probably meant, and what a setting may be."""

import difflib
import re
from collections.abc import Iterator
from dataclasses import MISSING, Field, fields, is_dataclass
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

from hydra.errors import MissingConfigException, OverrideParseException
from omegaconf.errors import OmegaConfBaseException

__all__ = ["explained"]

_WORDS = {
    int: "a whole number",
    float: "a number",
    bool: "true or false",
    str: "text",
    list: "a list in brackets, as in [1,2]",
    dict: "a mapping in braces, as in {name:1}",
}


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
        return f"{text}{_guess(name, list(_names(schema)))} --cfg job lists all settings."
    if isinstance(error, MissingConfigException) and error.missing_cfg_file and error.options:
        group, _, choice = error.missing_cfg_file.partition("/")
        known = [option for option in error.options if option != "__init__"]
        nested = [f"{one}/..." for one in known if one == "metaworld"]
        listed = ", ".join([*(one for one in known if one != "metaworld"), *nested])
        return f"unknown {group} {choice!r}.{_guess(choice, known)} Known: {listed}."
    if isinstance(error, OverrideParseException):
        quote = "quote text with spaces, commas or brackets, as in 'name=\"a, b\"'"
        return f"{error.override} cannot be read as name=value ({text.splitlines()[0]}); {quote}"
    cause = error if isinstance(error, OmegaConfBaseException) else error.__cause__
    if isinstance(cause, OmegaConfBaseException) and cause.full_key:
        return _of_another_kind(text, cause, schema)
    return text


def _of_another_kind(text: str, error: OmegaConfBaseException, schema: type) -> str:
    """What a setting may be that was given something of another kind."""
    name = re.sub(r"\[\d+\]", "", str(error.full_key))
    reason = str(error).splitlines()[0]
    found = _field(name, schema)
    if found is None:
        return f"{text}: {reason}"
    kind, default = found
    given = re.match("Error merging override (.*)", text)
    came = f", got {given[1]}" if given else ""
    return f"{name} must be {_expected(name, kind, default)}{came} ({reason})"


def _expected(name: str, kind: Any, default: Any) -> str:
    options = get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,)
    optional = " or null" if NoneType in options else ""
    kind = next(option for option in options if option is not NoneType)
    if is_dataclass(kind):
        first = fields(kind)[0]
        return f"given part by part, as in {name}.{first.name}={_default(first)}"
    words = _WORDS.get(get_origin(kind) or kind, "of another kind")
    inner = [_WORDS[part] for part in get_args(kind)[-1:] if part in _WORDS]
    of = f" of entries that are each {inner[0]}" if inner else ""
    such = "" if default in (None, "") or of or kind is bool else f" such as {default}"
    return f"{words}{of}{optional}{such}"


def _field(name: str, schema: type) -> tuple[Any, Any] | None:
    """Type and default of the setting of a name; None if there is none."""
    section, kind, default = schema, None, None
    for part in name.split("."):
        if not is_dataclass(section):
            break  # an entry of a mapping: what the mapping is says enough
        found = {field.name: field for field in fields(section)}.get(part)
        if found is None:
            return None
        kind, default = get_type_hints(section)[part], _default(found)
        section = kind
    return None if kind is None else (kind, default)


def _default(field: "Field[Any]") -> Any:
    if field.default_factory is not MISSING:
        return field.default_factory()
    return field.default


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
