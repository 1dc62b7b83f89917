"""Completing the text of a workcell file: comments and order as they were, values added."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from symbolic import outside
from symbolic.errors import OutsideError, SettingsError

Changes = Mapping[str, Any]
"""Tables and keys to be set: {'task': {'initial': ...}, 'robots': [{...}, {...}]}; a list of tables
that is there already is changed entry by entry, a key with the value None is removed."""

INLINE = ("base", "pad")
"""Tables that are written in one line."""


def completed(text: str, data: Mapping[str, Any], changes: Changes) -> str:
    """A workcell file's text with values set.

    Args:
        text: the file; '' to write `data` without comments.
        data: what the file holds, without what is replaced.
        changes: what is set.

    Raises:
        SettingsError: the file is written in a way that cannot be completed, or TOML Kit is not
            installed.
    """
    tomlkit = _library()
    wanted = merged(data, changes)
    document = tomlkit.parse(text) if text else tomlkit.document()
    if not text:
        for key, value in wanted.items():
            document[key] = _item(value)
    else:
        _apply(document, changes)
    found: str = tomlkit.dumps(document)
    try:
        same = _alike(outside.toml_tables(found.encode()), wanted)
    except OutsideError:
        same = False
    if not same:
        raise SettingsError(
            "the file cannot be completed as it is written; begin each section with a heading of "
            "its own ([task], [[contacts]]) and keep what belongs to one together"
        )
    return found


def _alike(found: Any, wanted: Any) -> bool:
    """Whether values are equal; what is no number is like itself, and told by the reader."""
    if isinstance(found, Mapping) and isinstance(wanted, Mapping):
        return found.keys() == wanted.keys() and all(_alike(found[k], wanted[k]) for k in found)
    if isinstance(found, list) and isinstance(wanted, list):
        return len(found) == len(wanted) and all(map(_alike, found, wanted))
    return bool(found == wanted) or (found != found and wanted != wanted)


def merged(data: Any, changes: Any) -> Any:
    """What a file says after the changes, as plain values; also changes after further ones."""
    if isinstance(changes, Mapping) and isinstance(data, Mapping):
        found = dict(data)
        for key, value in changes.items():
            if value is None:
                found.pop(key, None)
            else:
                found[key] = merged(found[key], value) if key in found else value
        return found
    if _tables(changes) and _tables(data) and len(changes) == len(data):
        return [merged(old, new) for old, new in zip(data, changes, strict=True)]
    return changes


def _tables(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(entry, Mapping) for entry in value)


def _apply(place: Any, changes: Any) -> None:
    for key, value in changes.items():
        if value is None:
            place.pop(key, None)
        elif isinstance(value, Mapping) and key in place:
            _apply(place[key], value)
        elif _tables(value) and key in place and len(value) == len(place[key]):
            for old, new in zip(place[key], value, strict=True):
                _apply(old, new)
        else:
            place[key] = _item(value)


def _item(value: Any) -> Any:
    """A value as TOML: tables with headings, rows of numbers one below the other."""
    tomlkit = _library()
    if isinstance(value, Mapping):
        table = tomlkit.table()
        for key, entry in value.items():
            if key in INLINE and isinstance(entry, Mapping):
                table[key] = tomlkit.inline_table()
                table[key].update(entry)
            else:
                table[key] = _item(entry)
        return table
    if value and _tables(value):
        tables = tomlkit.aot()
        for entry in value:
            tables.append(_item(entry))
        return tables
    if isinstance(value, list) and value and isinstance(value[0], list):
        rows = tomlkit.array()
        for row in value:
            rows.append(row)
        return rows.multiline(True)
    return value


def _library() -> Any:
    try:
        import tomlkit
    except ImportError as error:
        raise SettingsError(
            "a proposed file is completed by TOML Kit, which is not installed: "
            'pip install "dual-arm-carry[propose]"'
        ) from error
    return tomlkit
