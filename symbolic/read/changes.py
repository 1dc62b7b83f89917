"""A workcell file's text with other values: the same cell but for what was changed."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from symbolic import outside
from symbolic.errors import WorkcellError
from symbolic.records.problems import shown

_BARE = re.compile(r"[A-Za-z0-9_-]+")
_INDEX = re.compile(r"\[(\d+)\]\.?(.*)", re.DOTALL)


def changed_text(content: bytes, changes: Mapping[str, Any], file: str) -> bytes:
    """The text of a workcell file in which some keys have other values; comments are lost.

    Args:
        content: of the file.
        changes: values by key path as in the file: 'payload.mass', 'task.goal'. An array of tables
            is followed by an index or by a table's name, or else every table is meant:
            'contacts[0].friction', 'contacts.friction', 'environment.top board.xyz'.
        file: for messages.

    Raises:
        WorkcellError: with every path that leads nowhere.
        OutsideError: the content is no TOML.
    """
    data, problems = outside.toml_tables(content), []
    for path, value in changes.items():
        owners = list(_owners(data, path))
        if not owners:
            problems.append(
                f"{path}: leads nowhere in the file; allowed are its keys, see the docs"
            )
        for table, key in owners:
            table[key] = _plain(value)
    if problems:
        raise WorkcellError(file, tuple(problems))
    return "".join(_table(data, "")).encode()


def _owners(table: Any, path: str) -> Iterator[tuple[dict[str, Any], str]]:
    """Every table that a key path ends in, and its last key."""
    key, _, rest = path.partition(".")
    name, bracket, index = key.partition("[")
    if bracket:
        rest = f"[{index}" + (f".{rest}" if rest else "")
    if not name or not isinstance(table, dict):
        return
    if not rest:
        yield table, name
        return
    inner = table.get(name)
    if isinstance(inner, list) and inner and all(isinstance(entry, dict) for entry in inner):
        yield from _among(inner, rest)
    elif not bracket:
        yield from _owners(table.setdefault(name, {}) if inner is None else inner, rest)


def _among(tables: list[dict[str, Any]], rest: str) -> Iterator[tuple[dict[str, Any], str]]:
    """The same of an array of tables, by an index, a name, or all of them."""
    if found := _INDEX.match(rest):
        k = int(found[1])
        if k < len(tables):
            yield from _owners(tables[k], found[2])
        return
    named = [t for t in tables if rest.startswith(f"{t.get('name')}.")]
    for table in named or tables:
        yield from _owners(table, rest.removeprefix(f"{table['name']}.") if named else rest)


def _plain(value: Any) -> Any:
    """A value as TOML knows it."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    return [_plain(entry) for entry in value] if isinstance(value, tuple | list) else value


# --- TOML ---


def _table(table: Mapping[str, Any], path: str) -> Iterator[str]:
    """The lines of a table: its own keys, then those of tables within it."""
    inner = {key: value for key, value in table.items() if _is_section(value)}
    for key, value in table.items():
        if key not in inner:
            yield f"{_key(key)} = {_value(value)}\n"
    for key, value in inner.items():
        heading = f"{path}{_key(key)}"
        for entry in [value] if isinstance(value, Mapping) else value:
            yield f"\n[{heading}]\n" if entry is value else f"\n[[{heading}]]\n"
            yield from _table(entry, f"{heading}.")


def _is_section(value: Any) -> bool:
    if isinstance(value, Mapping):
        return True
    tables = isinstance(value, list) and value
    return bool(tables) and all(isinstance(entry, Mapping) for entry in value)


def _key(key: str) -> str:
    return key if _BARE.fullmatch(key) else json.dumps(key, ensure_ascii=False)


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, list):
        return f"[{', '.join(map(_value, value))}]"
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{_key(k)} = {_value(v)}' for k, v in value.items())}}}"
    raise WorkcellError("changes", (f"found {shown(value)}; allowed is what TOML knows",))
