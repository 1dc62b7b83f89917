"""The JSON Schema of workcell files, judged by jsonschema, beside what the reader accepts."""

from __future__ import annotations

import copy
import json
import re
import tempfile
import tomllib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from jsonschema import Draft202012Validator

from studies.schema import main
from symbolic.errors import DualArmError, WorkcellError
from symbolic.read.cell import load
from symbolic.read.schema import workcell_schema
from tests.fuzz.damage import Tree, tree_damage
from tests.symbolic.read.samples import STUDIES, sample_data, write

VALIDATOR = Draft202012Validator(workcell_schema())
SHIPPED = sorted([*STUDIES.glob("workcells/*.toml"), *STUDIES.glob("problems/*.toml")])
UNKNOWN = "zz_9"


def test_the_schema_is_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    printed = json.loads(capsys.readouterr().out)
    Draft202012Validator.check_schema(printed)
    assert printed == workcell_schema()


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_every_shipped_file_is_accepted(path: Path) -> None:
    assert [error.message for error in VALIDATOR.iter_errors(_read(path))] == []


def test_it_refuses_a_wrong_word_unit_and_key_where_they_stand() -> None:
    data = sample_data()
    data["payload"]["size"] = [300.0, 0.4, 0.25]
    data["task"]["time_law"] = "fast"
    data["robots"][1]["speed"] = 1.0
    places = {error.json_path for error in VALIDATOR.iter_errors(data)}
    assert places == {"$.payload.size[0]", "$.task.time_law", "$.robots[1]"}


@settings(max_examples=60, suppress_health_check=list(HealthCheck), deadline=None)
@given(tree_damage())
def test_it_refuses_nothing_that_the_reader_accepts(damaged: Tree) -> None:
    data = damaged(sample_data())
    with tempfile.TemporaryDirectory() as folder:
        path = write(Path(folder), data)
        try:
            load(path)
        except DualArmError:
            return
        assert [error.message for error in VALIDATOR.iter_errors(_read(path))] == []


def test_keys_are_those_that_the_reader_knows(tmp_path: Path) -> None:
    """The reader lists what it allows beside an unknown key; of bodies and payloads by kind."""
    cell = sample_data()
    cell["robots"][0] |= {"driver": {}, "tool_load": {"mass": 1.0}}
    cell |= {"collision": {"ignored": [{}]}, "uncertainty": {}, "handling": {}}
    cell["contacts"][0] |= {"further": [{}], "kind": "cup"}
    cell["task"] |= {"redundant": [{}], "allowed_contacts": [{}], "waypoints": [{}]}
    kinds = ("box", "cylinder", "sphere", "mesh")
    cell["environment"] = [{"name": kind, "kind": kind} for kind in kinds]
    known: dict[str, set[str]] = {}
    for payload in ("box", "cylinder", "mesh"):
        cell["payload"]["kind"] = payload
        with pytest.raises(WorkcellError) as refusal:
            load(write(tmp_path, _with_unknown_keys(cell)))
        for problem in refusal.value.problems:
            found = re.fullmatch(rf"(.*?)\.?{UNKNOWN}: unknown key; allowed keys are (.*)", problem)
            if found:
                place = re.sub(r"\[\d+\]", "[]", found[1])
                known.setdefault(place, set()).update(found[2].split(", "))
    stated = dict(_tables(workcell_schema()))
    # Every kind of body has the same keys wherever it stands.
    known["robots[].tool[]"] = known["environment[]"]
    assert {place: sorted(keys) for place, keys in known.items()} == {
        place: sorted(keys) for place, keys in stated.items()
    }


def _read(path: Path) -> Any:
    return tomllib.loads(path.read_text("utf-8"))


FREE = ("xacro_arguments", "locked_joints")
"""Tables whose keys are names."""


def _with_unknown_keys(tree: Any) -> Any:
    """The tree with an unknown key in every table."""
    tree = copy.deepcopy(tree)
    if isinstance(tree, list):
        return [_with_unknown_keys(entry) for entry in tree]
    if not isinstance(tree, dict):
        return tree
    inner = {
        key: value if key in FREE else _with_unknown_keys(value) for key, value in tree.items()
    }
    return inner | {UNKNOWN: 1}


def _tables(schema: dict[str, Any], place: str = "") -> list[tuple[str, list[str]]]:
    """Every table of a schema with its keys."""
    if schema.get("type") == "array" and isinstance(schema.get("items"), dict):
        return _tables(schema["items"], f"{place}[]")
    if "properties" not in schema:
        return []
    found = [(place, list(schema["properties"]))]
    for key, inner in schema["properties"].items():
        found += _tables(inner, f"{place}.{key}" if place else key)
    return found
