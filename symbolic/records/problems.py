"""Collector of a file's problems by key path, words for their messages, and patterns of names."""

from __future__ import annotations

import difflib
import re
import reprlib
import unicodedata
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Annotated, Any

from symbolic.array import TextPattern

MAX_NAME_LENGTH = 80


MOST_LETTERS = 2000
"""Largest length of the text of a problem, which may quote the found value or list the allowed
ones."""

MOST_PROBLEMS = 100
"""Largest number of problems of a file that are listed; further ones are counted."""


LONGEST_SUGGESTION = 200
"""Similar words are looked for only if the misspelt word is not longer."""


@dataclass
class Problems:
    """Problems found in a file so far.

    Attributes:
        found: pairs of key path and text, at most `MOST_PROBLEMS`.
        uncounted: number of problems beyond these.
        open: True if unknown keys are allowed.
    """

    found: list[tuple[str, str]] = field(default_factory=list)

    uncounted: int = 0

    open: bool = False
    """True if unknown keys are no problem."""

    def add(self, path: str, text: str) -> None:
        """Record a problem, or only count it if `MOST_PROBLEMS` problems are recorded already.

        Args:
            path: key path of the wrong value.
            text: the value that was found, and what is allowed.
        """
        if len(self.found) < MOST_PROBLEMS:
            told = text if len(text) <= MOST_LETTERS else f"{text[: MOST_LETTERS - 4]} ..."
            self.found.append((path, told))
        else:
            self.uncounted += 1

    def clean(self, *prefixes: str) -> bool:
        """Return True if no problem was found at the values of the key paths `prefixes`: neither at
        a path itself, nor at a key inside it, nor at a table that contains it."""
        return not any(
            _is_within(path, prefix) or _is_within(prefix, path)
            for path, _ in self.found
            for prefix in prefixes
        )

    def messages(self) -> tuple[str, ...]:
        """Return all recorded problems as `key.path: text`, then a line with the number of further
        problems if there are any."""
        told = tuple(f"{path}: {text}" for path, text in self.found)
        return (*told, f"and {self.uncounted} more") if self.uncounted else told


class FirstProblem(Problems):
    """Collector of problems that raises the first problem as an error at once."""

    def add(self, path: str, text: str) -> None:
        """Raise the problem as an error.

        Raises:
            ValueError: always; the message has the key path and the text.
        """
        raise ValueError(f"{path}: {text}")


def _is_within(path: str, prefix: str) -> bool:
    return path == prefix or path.startswith((f"{prefix}.", f"{prefix}["))


def suggestion(word: str, candidates: Iterable[str]) -> str:
    """Return the text '; did you mean ...?' with the candidate that is most similar to a misspelt
    word; '' if none is similar."""
    if len(word) > LONGEST_SUGGESTION:
        return ""
    close = difflib.get_close_matches(word, list(candidates), n=1, cutoff=0.6)
    return f"; did you mean {close[0]!r}?" if close else ""


def shown(value: Any) -> str:
    """Return a value as a short single line for a message, with control characters escaped.

    A long value is shortened in the middle, since a path is recognised by its last part.
    """
    text = _short.repr(value)
    return text if len(text) <= 60 else f"{text[:28]}...{text[-29:]}"


class _Short(reprlib.Repr):
    """Variant of `repr` that reads only as much of a value as a message can show."""

    def repr_int(self, x: int, level: int) -> str:
        """Return an integer x as text: its digits, or only its number of bits if it has 200 or
        more.

        Python refuses to print thousands of digits.
        """
        return repr(x) if x.bit_length() < 200 else f"a number of {x.bit_length()} bits"


_short = _Short()
_short.maxlevel, _short.maxstring, _short.maxother = 4, 200, 200
_short.maxlist = _short.maxdict = 60


def text_problem(value: Any) -> str:
    """Return what is wrong with a value that should be a text for reports; '' if nothing is
    wrong."""
    if not isinstance(value, str):
        return "allowed is a text"
    if not value.strip():
        return "allowed is a text that is not empty"
    if len(value) > MAX_NAME_LENGTH:
        return f"it has {len(value)} characters; allowed are {MAX_NAME_LENGTH}"
    if value != value.strip():
        return "allowed is a text without spaces at its ends"
    if any(unicodedata.category(character).startswith(("C", "Zl", "Zp")) for character in value):
        return "it contains a control character; allowed are printable characters in one line"
    return ""


Label = Annotated[str, TextPattern(text_problem)]
"""A text for people and reports."""


def text_pattern(pattern: str, meaning: str) -> TextPattern:
    """Return a `TextPattern` that allows the texts that match a regular expression.

    Args:
        pattern: the regular expression.
        meaning: description of the allowed texts, for messages.
    """
    form = re.compile(pattern)

    def problem(value: Any) -> str:
        return "" if isinstance(value, str) and form.fullmatch(value) else f"allowed: {meaning}"

    return TextPattern(problem)


# --- patterns for several names ---


def matching(pattern: str, names: Iterable[str]) -> tuple[str, ...]:
    """Return those of the `names` that match a pattern, in which `*` stands for any text and `?`
    for any character.

    A pattern that equals a name matches this name only, even if it contains such characters.
    """
    names = tuple(names)
    if pattern in names:
        return (pattern,)
    words = {"*": ".*", "?": "."}
    form = re.compile("".join(words.get(letter, re.escape(letter)) for letter in pattern))
    return tuple(name for name in names if form.fullmatch(name))
