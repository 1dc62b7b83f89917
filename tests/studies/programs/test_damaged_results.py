"""Damaged results end in one message that names the file, and exit code 2."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from studies import compare
from studies.report import __main__ as report
from studies.research import control

PROGRAMS: dict[str, Callable[[Path, Path], int]] = {
    "report": lambda damaged, whole: report.main([str(damaged), "--quiet"]),
    "compare": lambda damaged, whole: compare.main([str(whole), str(damaged)]),
    "control": lambda damaged, whole: control.main([str(damaged), "--evaluations", "200"]),
}


def put(path: str, value: Any) -> Callable[[Any], Any]:
    """Puts a value at a dotted path of a document."""

    def change(document: Any) -> Any:
        *parents, last = path.split(".")
        place = document
        for name in parents:
            place = place[int(name) if isinstance(place, list) else name]
        place[int(last) if isinstance(place, list) else last] = value
        return document

    return change


FIRST = "algorithms.nsga2.replicas.0"

SUMMARIES = {
    "empty object": lambda document: {},
    "a list": lambda document: [],
    "a text": lambda document: "summary",
    "text for a record": put("static_hold", "none"),
    "text for a number": put(f"{FIRST}.hypervolume", "0.4"),
    "text for numbers": put("reference_force", "ab"),
    "text for replicas": put("algorithms.nsga2.replicas", "ab"),
    "number for algorithms": put("algorithms", 3),
    "numbers for algorithms": put("settings.algorithms", [1, 2]),
    "zero replicas": put("settings.replicas", 0),
    "no replicas": put("algorithms.nsga2.replicas", []),
    "infinite": put(f"{FIRST}.hypervolume", 1e999),
    "a huge whole number": put(f"{FIRST}.hypervolume", 10**400),
    "negative": put(f"{FIRST}.feasible", -1),
    "true for a number": put(f"{FIRST}.feasible", True),
    "half a letter": put("workcell.name", "\ud800"),
    "no such replica": put("algorithms.nsga2.representative", 7),
    "three robots": put("static_hold.normal_force", [1.0, 2.0, 3.0]),
    "of another campaign": put("settings.seed", 99),
}

CONFIGURATIONS = {
    "numbers for algorithms": put("settings.algorithms", [1, 2]),
    "no algorithms": put("settings.algorithms", {}),
    "zero replicas": put("settings.replicas", 0),
    "text for replicas": put("settings.replicas", "2"),
    "unknown handling": put("settings.constraint_handling", "prayer"),
    "no workcell": put("workcell", None),
    "a version of letters": put("version", "\ud800"),
}

MARKS = {
    "text for seconds": put("seconds", "2"),
    "infinite seconds": put("seconds", 1e999),
    "negative seconds": put("seconds", -1.0),
    "no checksums": put("sha256", {}),
    "an empty object": lambda document: {},
}


def damage(path: Path, change: Callable[[Any], Any]) -> None:
    path.write_text(json.dumps(change(json.loads(path.read_text()))))


def check(
    program: str, damaged: Path, whole: Path, file: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert PROGRAMS[program](damaged, whole) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.count("\n") == 1
    assert file in printed.err
    assert "Traceback" not in printed.err


@pytest.mark.parametrize("program", PROGRAMS)
@pytest.mark.parametrize("fault", SUMMARIES)
def test_summaries(
    study: Path, own_study: Path, program: str, fault: str, capsys: pytest.CaptureFixture[str]
) -> None:
    damage(own_study / "summary.json", SUMMARIES[fault])
    check(program, own_study, study, "summary.json", capsys)


@pytest.mark.parametrize("program", PROGRAMS)
@pytest.mark.parametrize("fault", CONFIGURATIONS)
def test_configurations(
    study: Path, own_study: Path, program: str, fault: str, capsys: pytest.CaptureFixture[str]
) -> None:
    damage(own_study / "configuration.json", CONFIGURATIONS[fault])
    check(program, own_study, study, "configuration.json", capsys)


@pytest.mark.parametrize("fault", MARKS)
def test_finished_replicas(
    study: Path, own_study: Path, fault: str, capsys: pytest.CaptureFixture[str]
) -> None:
    damage(own_study / "replicas/nsga2/01/replica.json", MARKS[fault])
    check("compare", own_study, study, "replicas/nsga2/01", capsys)
