"""Patterns that stand for several names."""

from __future__ import annotations

import re
from collections.abc import Iterable


def matching(pattern: str, names: Iterable[str]) -> tuple[str, ...]:
    """The names that a pattern stands for: `*` is any text, `?` any character.

    A name that is written out stands for itself, also where it holds such a character.
    """
    names = tuple(names)
    if pattern in names:
        return (pattern,)
    words = {"*": ".*", "?": "."}
    form = re.compile("".join(words.get(letter, re.escape(letter)) for letter in pattern))
    return tuple(name for name in names if form.fullmatch(name))
