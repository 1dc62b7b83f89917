"""Changes to the text of a workcell file that keep comments and order.

TOML Kit takes long to load, so readers of cells import this module only in functions that change a
text.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import AoT, Null, Table, Whitespace

from symbolic import safe_io
from symbolic.errors import OutsideError, SettingsError
from symbolic.read.descriptions import RELATIVE

Changes = Mapping[str, Any]
"""Tables and keys to be set: {'task': {'initial': ...}, 'robots': [{...}, {...}]}. An existing list
of tables is changed entry by entry. A key with the value None is removed."""

INLINE = ("base", "pad")
"""Names of tables that are written on one line."""


def completed(text: str, data: Mapping[str, Any], changes: Changes) -> str:
    """Return the text of a workcell file with some values set.

    Args:
        text: text of the file; '' to write a new text from `data` and the changes, without
            comments.
        data: parsed content of the file.
        changes: nested tables with the values to set; None removes a key.

    Raises:
        SettingsError: the file is written in a way that cannot be edited.
    """
    wanted = merged(data, changes)
    if text and wanted == data:
        return text
    return _edited(text, wanted, lambda document: _apply(document, changes if text else wanted))


def with_paths(data: Mapping[str, Any], change: Callable[[str], str]) -> Changes:
    """Return changes of a workcell file that replace every path of a robot, tool, environment or
    payload file by another path.

    Args:
        data: the tables of the workcell file.
        change: function from a path or a package address to its replacement.
    """

    def changed(table: Any, *keys: str) -> dict[str, Any]:
        names = {key: table.get(key) for key in keys} if isinstance(table, Mapping) else {}
        found = {key: change(name) for key, name in names.items() if isinstance(name, str)}
        return {key: name for key, name in found.items() if name != names[key]}

    found: dict[str, Any] = {"robots": [], "payload": changed(data.get("payload"), "path")}
    for robot in data["robots"]:
        entry: dict[str, Any] = changed(robot, "urdf", "srdf")
        arguments = robot.get("xacro_arguments")
        if isinstance(arguments, Mapping):
            paths = {k: v for k, v in arguments.items() if str(v).startswith(RELATIVE)}
            others = {key: f"./{path}" for key, path in changed(paths, *paths).items()}
            entry |= {"xacro_arguments": others} if others else {}
        folders = robot.get("package_dirs")
        if isinstance(folders, list):
            renamed = [change(str(name)) for name in folders]
            entry |= {"package_dirs": renamed} if renamed != folders else {}
        if isinstance(robot.get("tool"), list):
            entry["tool"] = [changed(body, "path") for body in robot["tool"]]
        found["robots"].append(entry)
    if isinstance(data.get("environment"), list):
        found["environment"] = [changed(body, "path") for body in data["environment"]]
    return found


def extended(text: str, data: Mapping[str, Any], key: str, tables: list[dict[str, Any]]) -> str:
    """Return a workcell file's text with tables appended to an array such as `[[environment]]`.

    Args:
        text: text of the file.
        data: parsed content of the file.
        key: key of the array at the top level; the file may lack it.
        tables: the new tables.

    Raises:
        SettingsError: the file is written in a way that cannot be edited.
    """
    before = data.get(key, [])
    wanted = {**data, key: [*(before if isinstance(before, list) else ()), *tables]}

    def add(document: tomlkit.TOMLDocument) -> None:
        if key not in document:
            document[key] = _item(tables)
        elif isinstance(document[key], AoT):
            for table in map(_item, tables):
                table.add(tomlkit.nl())
                document[key].append(table)

    return _edited(text.rstrip() + "\n\n", wanted, add).rstrip() + "\n"


def _edited(
    text: str, wanted: Mapping[str, Any], edit: Callable[[tomlkit.TOMLDocument], None]
) -> str:
    """Edit a text, and return it if it then has the wanted content.

    Args:
        text: TOML text of the file.
        wanted: content that the edited text has to have.
        edit: function that edits the document.

    Raises:
        SettingsError: the edited text has another content, because of how the file is written.
    """
    with suppress(OutsideError, TOMLKitError, LookupError, TypeError, ValueError):
        document = tomlkit.parse(text)
        edit(document)
        found = document.as_string()
        if _alike(safe_io.toml_tables(found.encode()), wanted):
            return found
    raise SettingsError(
        "the file cannot be completed as it is written; begin each section with a heading of "
        "its own ([task], [[contacts]]) and keep what belongs to one together",
        code="not-completable",
    )


def _alike(found: Any, wanted: Any) -> bool:
    """Return True if two nested values `found` and `wanted` are equal. Two NaN count as equal."""
    if isinstance(found, Mapping) and isinstance(wanted, Mapping):
        return found.keys() == wanted.keys() and all(_alike(found[k], wanted[k]) for k in found)
    if isinstance(found, list) and isinstance(wanted, list):
        return len(found) == len(wanted) and all(map(_alike, found, wanted))
    return bool(found == wanted) or (found != found and wanted != wanted)


def merged(data: Any, changes: Any) -> Any:
    """Merge nested changes into nested values; None in the changes removes a key.

    Args:
        data: nested tables and arrays of a workcell file, or earlier changes of them.
        changes: the changes. An array of tables is merged table by table if both arrays have the
            same length; any other value replaces the old one.
    """
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
    heading = _cut_heading(place)
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
    body = _last_body(place)
    while heading and body and isinstance(body[-1][1], Whitespace | Null):
        body.pop()  # before a table that is gone, and its place
    body.extend(heading)


def _cut_heading(place: Any) -> list[Any]:
    """Remove and return the blank lines and comments at the end of a table's text, from the first
    blank line on.

    They belong to the next table, so new keys of this table are written before them.
    """
    body = _last_body(place)
    blank = end = len(body)
    while end and body[end - 1][0] is None:
        end -= 1
        if isinstance(body[end][1], Whitespace):
            blank = end
    heading = body[blank:]
    del body[blank:]
    return heading


def _last_body(place: Any) -> list[Any]:
    """Return the body of the innermost table at the end of a tomlkit item's text.

    The body is the table's own list of (key, item) pairs in the order of the file; comments and
    blank lines have the key None. The list is empty if the item is an inline table, a table written
    in several places, or no table.
    """
    if isinstance(place, AoT):
        return _last_body(place[-1]) if len(place) else []
    if not isinstance(place, Table | tomlkit.TOMLDocument):
        return []
    body: list[Any] = (place.value if isinstance(place, Table) else place).body
    return (body and _last_body(body[-1][1])) or body


def _item(value: Any) -> Any:
    """Convert a value to a tomlkit item, such that tables get headings and an array of arrays has
    one row per line."""
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
