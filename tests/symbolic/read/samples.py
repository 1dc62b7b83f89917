"""Workcell files for tests: a valid cell as plain data to change, and a writer for such data."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import studies

STUDIES = Path(studies.__file__).parent
RACK = STUDIES / "workcells" / "rack.toml"
SAMPLE = Path(__file__).with_name("sample_cell.toml")
GOFA = STUDIES / "robots" / "gofa12.urdf"


def sample_data() -> dict[str, Any]:
    """A valid cell's content with absolute URDF paths, fresh at each call."""
    data = tomllib.loads(SAMPLE.read_text(encoding="utf-8"))
    for robot in data["robots"]:
        robot["urdf"] = str(GOFA)
    return data


def write(folder: Path, data: dict[str, Any]) -> Path:
    """A TOML file with this content."""
    path = folder / "cell.toml"
    text = "\n".join(f"{_key(key)} = {_value(value)}" for key, value in data.items())
    path.write_text(text + "\n", encoding="utf-8")
    return path


def _key(key: str) -> str:
    return json.dumps(key, ensure_ascii=False)


def _value(value: Any) -> str:
    """An inline TOML value; tables are written inline, which TOML treats alike."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_key(k)} = {_value(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_value(entry) for entry in value) + "]"
    if isinstance(value, bool | str):
        return json.dumps(value, ensure_ascii=False)
    return repr(value)  # numbers; nan and inf are written as in TOML
