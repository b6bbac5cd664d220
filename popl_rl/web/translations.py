"""What pages say: one JSON file for each language, ``texts/en.json`` to translate from."""

import json
from collections.abc import Mapping
from functools import cache
from importlib.resources import files

__all__ = ["LANGUAGES", "phrases"]

#: Languages that there are, by their codes.
LANGUAGES = ("en", "de")


@cache
def phrases(language: str) -> Mapping[str, str]:
    """Phrases by name; those that a language lacks are English.

    Args:
        language: A code in ``LANGUAGES``.

    Raises:
        ValueError: If there is no such language.
    """
    if language not in LANGUAGES:
        raise ValueError(f"language must be one of {', '.join(LANGUAGES)}, got {language!r}")
    found: dict[str, str] = {}
    for code in ("en", language):
        text = (files("popl_rl.web") / "texts" / f"{code}.json").read_text(encoding="utf-8")
        found |= json.loads(text)
    return found
