"""Each wrong entry of a workcell file is told with its key path, the find and the remedy."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from symbolic.errors import WorkcellError
from symbolic.read.cell import load
from symbolic.records import Workcell
from tests.symbolic.read.problem_cases import CASES, put
from tests.symbolic.read.samples import GOFA, RACK, sample_data, write
from tests.waiting import soon


def problems_of(path: Path) -> list[str]:
    with pytest.raises(WorkcellError) as caught:
        load(path)
    assert str(path) in str(caught.value)
    assert all(problem in str(caught.value) for problem in caught.value.problems)
    return list(caught.value.problems)


@pytest.mark.parametrize(
    "case", CASES, ids=[f"{index}-{case[0]}" for index, case in enumerate(CASES)]
)
def test_problem(tmp_path: Path, case: tuple[Any, ...]) -> None:
    where, value, words, told = case if len(case) == 4 else (*case, case[0])
    data = sample_data()
    put(data, where, value)
    found = problems_of(write(tmp_path, data))
    assert any(problem.startswith(f"{told}: ") and words in problem for problem in found), found
    for problem in found:
        assert problem.isprintable(), problem


def test_one_mistake_is_one_problem(tmp_path: Path) -> None:
    data = sample_data()
    put(data, "payload.size[0]", 300)
    put(data, "contacts[0].spin", 45)
    found = problems_of(write(tmp_path, data))
    assert [problem.split(":")[0] for problem in found] == ["payload.size[0]", "contacts[0].spin"]


def test_a_missing_section_does_not_blame_others(tmp_path: Path) -> None:
    data = sample_data()
    del data["payload"]
    assert problems_of(write(tmp_path, data)) == ["payload: is missing"]


def test_many_problems_at_once(tmp_path: Path) -> None:
    data = sample_data()
    wrong: list[tuple[str, Any, str]] = [
        ("robots[0].flange", "tol0", "robots[0].flange"),
        ("robots[1].base.rpy[2]", 90, "robots[1].base.rpy[2]"),
        ("payload.mass", -1, "payload.mass"),
        ("contacts[0].xyz[1]", 0.3, "contacts[0].xyz"),
        ("task.samples", 2, "task.samples"),
        ("task.extra", 2, "task.extra"),
        ("task.goal[2]", 3.0, "task.goal"),
        ("environment[3].size[0]", -1, "environment[3].size[0]"),
        ("collision.tolerance", 5, "collision.tolerance"),
    ]
    for where, value, _ in wrong:
        put(data, where, value)
    found = problems_of(write(tmp_path, data))
    told = {problem.split(": ")[0] for problem in found}
    # The goal cannot be judged while both arms are described wrongly.
    assert told == {path for _, _, path in wrong} - {"task.goal"}


def test_both_arms_and_all_poses_are_judged(tmp_path: Path) -> None:
    data = sample_data()
    data["task"]["start"][2] = data["task"]["goal"][2] = 2.6
    found = problems_of(write(tmp_path, data))
    assert [problem.split(": ")[0] for problem in found] == ["task.start", "task.goal"] * 2


def test_thousands_of_bodies_are_told_at_once(tmp_path: Path) -> None:
    data = sample_data()
    body = {"name": "x", "kind": "sphere", "radius": 0.1}
    data["environment"] = [body | {"name": f"x{k}"} for k in range(2000)]
    (told,) = problems_of(write(tmp_path, data))
    assert told.startswith("environment: found 2000 collision shapes, 2041 in the whole cell;")
    assert "raise collision.most_pieces" in told
    data["collision"]["most_pieces"] = 2041
    assert len(load(write(tmp_path, data)).environment) == 2000


def test_thousands_of_unknown_keys_are_counted(tmp_path: Path) -> None:
    data = sample_data() | {f"unknown_{k}": 1 for k in range(20_000)}
    with soon():
        found = problems_of(write(tmp_path, data))
    assert len(found) == 11
    assert found[-1] == "file: 19990 further unknown keys"


def test_thousands_of_problems_are_counted(tmp_path: Path) -> None:
    data = sample_data()
    data["environment"] = [{"name": 1} for _ in range(300)]
    found = problems_of(write(tmp_path, data))
    assert len(found) == 101
    assert found[-1].startswith("and ")


@pytest.mark.parametrize("key", ["urdf", "package_dirs"])
def test_names_of_thousands_of_letters(tmp_path: Path, key: str) -> None:
    data = sample_data()
    data["robots"][0][key] = "x" * 5000 if key == "urdf" else ["x" * 5000]
    (told,) = problems_of(write(tmp_path, data))
    assert told.startswith(f"robots[0].{key}")
    assert len(told) < 300


@pytest.mark.parametrize("kind", ["pipe", "device", "folder", "large"])
def test_what_is_no_plain_file_is_told(tmp_path: Path, kind: str) -> None:
    data = sample_data()
    odd = tmp_path / "odd"
    match kind:
        case "pipe":
            os.mkfifo(odd)
        case "device":
            odd.symlink_to("/dev/zero")
        case "folder":
            odd.mkdir()
        case "large":
            with odd.open("wb") as file:
                file.truncate(100 * 2**20)
    data["robots"][0]["urdf"] = "odd"
    data["environment"][0] = {"name": "m", "kind": "mesh", "path": "odd"}
    first, second = problems_of(write(tmp_path, data))
    words = {"large": "is too large (100 MiB); allowed are"}.get(kind, f"it is a {kind}")
    assert first.startswith("robots[0].urdf: ")
    assert second.startswith("environment[0].path: ")
    assert words in first
    assert words in second
    assert words in problems_of(odd)[0]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"name = ", "not valid TOML"),
        (b"name = 'a'\nname = 'b'", "not valid TOML"),
        (b"name = '\xff'", "byte 8 is not UTF-8"),
        (b"a = " + b"[" * 100_000, "nested too deeply"),
        (b"", "name: is missing"),
    ],
)
def test_unusable_files(tmp_path: Path, content: bytes, words: str) -> None:
    path = tmp_path / "cell.toml"
    path.write_bytes(content)
    assert any(words in problem for problem in problems_of(path))


UrdfChange = Callable[[str], str]
URDF_CASES: list[tuple[str, UrdfChange, str, str]] = [
    ("not xml", lambda text: text[:200], "robots[0].urdf", "not readable XML"),
    ("no robot", lambda _: "<a/>", "robots[0].urdf", "its root is <a>"),
    ("no links", lambda _: "<robot name='a'/>", "robots[0].urdf", "has no links"),
    (
        "planar",
        lambda text: text.replace('"joint_4" type="revolute"', '"joint_4" type="planar"'),
        "robots[0].urdf",
        "'joint_4' is of kind Planar; allowed are revolute",
    ),
    (
        "branched",
        lambda text: text.replace('<parent link="link_5"/>', '<parent link="link_4"/>'),
        "robots[0].urdf",
        "does not follow the joint before it",
    ),
    (
        "no effort",
        lambda text: text.replace('effort="390"', 'effort="0"'),
        "robots[0].torque_max",
        "the description gives 0 for joint 1",
    ),
    (
        "range reversed",
        lambda text: text.replace('upper="1.483529864195180"', 'upper="-5"'),
        "robots[0].position_lower[2]",
        "not below its upper limit -5 rad",
    ),
    (
        "mesh missing",
        lambda text: text.replace(
            '<box size="0.161 0.093 0.707"/>', '<mesh filename="package://a/b.stl"/>'
        ),
        "robots[0].urdf",
        "collision mesh 'package://a/b.stl' that it names does not exist",
    ),
    (
        "mesh missing far away",
        lambda text: text.replace(
            '<box size="0.161 0.093 0.707"/>', f'<mesh filename="package://{"a/" * 50}link.stl"/>'
        ),
        "robots[0].urdf",
        "a/a/a/link.stl' that it names does not exist",
    ),
]


@pytest.mark.parametrize(
    ("change", "key_path", "words"),
    [case[1:] for case in URDF_CASES],
    ids=[case[0] for case in URDF_CASES],
)
def test_unusable_urdf(tmp_path: Path, change: UrdfChange, key_path: str, words: str) -> None:
    text = GOFA.read_text(encoding="utf-8")
    assert change(text) != text
    (tmp_path / "arm.urdf").write_text(change(text), encoding="utf-8")
    data = sample_data()
    data["robots"][0]["urdf"] = "arm.urdf"
    found = problems_of(write(tmp_path, data))
    assert any(p.startswith(f"{key_path}: ") and words in p for p in found), found


def test_further_checks_run_on_a_valid_cell_only(tmp_path: Path) -> None:
    seen: list[str] = []

    def no_solution(workcell: Workcell) -> list[str]:
        seen.append(workcell.name)
        return ["task.start: no joint angles reach it; allowed is a pose within reach"]

    with pytest.raises(WorkcellError, match=r"task\.start: no joint angles"):
        load(RACK, checks=[no_solution])
    data = sample_data()
    put(data, "payload.mass", -1)
    with pytest.raises(WorkcellError, match=r"payload\.mass"):
        load(write(tmp_path, data), checks=[no_solution])
    assert len(seen) == 1


def test_the_joint_allocation_asks_for_pads_that_face_one_another(tmp_path: Path) -> None:
    """Of both radii of 31.5 mm, 0.9 are 56.7 mm."""
    data = sample_data()
    put(data, "task.allocation", "joint")
    put(data, "contacts[1].xyz", [0.056, -0.20, 0.0])
    assert load(write(tmp_path, data)).task.allocation == "joint"
    put(data, "contacts[1].xyz", [0.058, -0.20, 0.0])
    (found,) = problems_of(write(tmp_path, data))
    assert found.startswith("contacts[1].xyz: faces a point 0.058 m beside contacts[0]")
    put(data, "task.allocation", "paper")
    assert load(write(tmp_path, data)).task.allocation == "paper"
