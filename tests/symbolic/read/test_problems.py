"""Wrong workcell files: every problem is told at its place, all at once."""

from __future__ import annotations

import errno
import os
import re
from pathlib import Path
from typing import Any

import pytest

from symbolic.errors import WorkcellError
from symbolic.read.cell import load
from symbolic.records import Workcell
from tests.refusals import refused
from tests.symbolic.read.samples import GOFA, RACK, sample_data, write
from tests.waiting import soon

DELETE = object()
DRUM = {"kind": "cylinder", "radius": 0.25, "length": 0.3, "mass": 6.0}
ZERO_POSE = [0.0] * 6
LOWER = [0, 0, 2, 0, 0, 0]


NO_MESH = {"name": "m", "kind": "mesh", "path": "no.stl"}


def allowed(departure: float, body: str = "top board") -> dict[str, Any]:
    """A contact that is allowed, of a body of the sample."""
    return {"body": body, "departure": departure}


def ignored(second: str) -> dict[str, Any]:
    """A pair that is ignored: the payload and another body."""
    return {"first": "payload", "second": second, "reason": "r"}


def put(data: Any, path: str, value: Any) -> None:
    """Set, append to ('[+]') or delete the entry at a key path."""
    keys: list[Any] = [
        int(part[1:-1]) if re.fullmatch(r"\[\d+\]", part) else part
        for part in re.findall(r"[^.\[\]]+|\[\d+\]|\[\+\]", path)
    ]
    for key in keys[:-1]:
        data = data[key] if isinstance(data, list) else data.setdefault(key, {})
    if value is DELETE:
        del data[keys[-1]]
    elif keys[-1] == "[+]":
        data.append(value)
    else:
        data[keys[-1]] = value


# (where to put, what, what the message quotes; the key path that is told, if it is another)
CASES: list[tuple[Any, ...]] = [
    ("payload.mas", 3.0, " mass, "),
    ("task.refrence_speed", 0.1, "reference_speed"),
    ("robots[1].base.yaw", 1.0, "rpy, xyz"),
    ("name", DELETE, "missing"),
    ("payload.mass", "10 kg", "found '10 kg'"),
    ("payload", 3, "found 3; "),
    ("payload.size", [0.3, 0.4], " 3 numbers"),
    ("task.start", [0.0, 0.0, 0.7], " 6 numbers"),
    ("robots", [], "found 0 "),
    ("robots[0].package_dirs", ["."] * 101, "found 101 "),
    ("robots[0].urdf", "package://" + "a" * 9000, "package"),
    ("robots[0].urdf", "package://example-robot-data/../a.urdf", "example-robot-data/../a.urdf"),
    ("robots[0].robot", "ur10", "found beside 'robot'", "robots[0].urdf"),
    ("robots[0]", {"robot": "ur11"}, "'ur11'", "robots[0].urdf"),
    ("environment", 3, "[[environment]]"),
    ("robots[0].locked_joints", 3, "found 3; "),
    ("robots[0].package_dirs", "x", "found 'x'"),
    ("environment[0].kind", "boxx", "'box'"),
    ("handling", {"stand_off": 50}, " mm", "handling.stand_off"),
    ("uncertainty", {"pad_position": 0.04}, "0.0315 m", "uncertainty.pad_position"),
    ("uncertainty", {"tilt": 2}, " deg", "uncertainty.tilt"),
    ("uncertainty", {"internal": 2.0}, "'internal_force'", "uncertainty.internal"),
    ("task.allocation", "conic", "'paper', 'soft"),
    (
        "task.allocation",
        "joint",
        "joint",
    ),
    ("task.drivable_allocation", "joint", "polish"),
    ("task.force_limit", [60.0, 50.0], "found 60 above 50"),
    ("task.time_law", "toppra", "'constant', 'ramped'"),
    ("task.samples", 4, "found 4; "),
    ("payload.mass", float("nan"), "found nan"),
    ("payload.mass", 10**400, "found inf"),
    ("payload.size[1]", 0.0, "0.001 "),
    ("robots[0].jerk_max", 0, " rad/s^3"),
    ("robots[0].driver", {"adress": "a"}, "'address'", "robots[0].driver.adress"),
    ("robots[0].driver", {"address": 'x";EXIT'}, "IP", "robots[0].driver.address"),
    ("robots[0].driver", {"prefix": "1 a"}, "letter", "robots[0].driver.prefix"),
    ("robots[0].driver", {"rate": 1.0}, " 8000 Hz", "robots[0].driver.rate"),
    ("robots[0].driver", {"lag": 30}, " ms", "robots[0].driver.lag"),
    ("robots[0].driver", {"force_control": 1}, "false", "robots[0].driver.force_control"),
    ("task.samples", int("1" * 4000), "13285 bits"),
    # another unit
    ("payload.size[0]", 300, " 0.3 m"),
    ("payload.mass", 10_000, " 10 kg"),
    ("robots[0].base.rpy[2]", -90.0, "-1.5708 rad"),
    ("contacts[0].friction", 60, "%"),
    ("task.reference_force", 0.5, " 4.90332 N"),
    ("task.reference_force", [117.7, 0.5], " kgf", "task.reference_force[1]"),
    ("task.reference_angular_speed", 30, " deg/s"),
    ("payload.jerk_max", 30_000, " 30 m/s^3"),
    # inertia
    ("payload.inertia", "hollow", "'solid box'"),
    ("payload.inertia", [[0.1, 0, 0], [0, 0.1], [0, 0, 0.1]], "3 numbers", "payload.inertia[1]"),
    ("payload.inertia", [[0.1, 0.01, 0], [0, 0.1, 0], [0, 0, 0.1]], "symmetric"),
    ("payload.inertia", [[0.1, 0, 0], [0, 0.1, 0], [0, 0, 0]], "singular"),
    ("payload.inertia", [[0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.3]], "sum"),
    ("payload.inertia", [[185, 0, 0], [0, 127, 0], [0, 0, 208]], "inside"),
    ("payload.centre_of_mass", [0, 0.21, 0], "outside", "payload.centre_of_mass[1]"),
    ("payload", {"kind": "drum", "mass": 1.0}, "'box', 'cylinder', 'mesh'", "payload.kind"),
    # contacts
    ("payload", DRUM, "normal", "contacts[0].xyz"),
    ("contacts[0].xyz", [0, 0.19, 0], "0.01 m inside"),
    ("contacts[0].xyz", [0.15, 0.20, 0], "edge"),
    ("contacts[0].xyz", [0.14, 0.20, 0], "0.01 m "),
    ("contacts[1].xyz", [0, 0.20, 0], "180 "),
    ("contacts[1].xyz", [0.15, 0, 0], " 90 "),
    # task
    ("task.waypoints[1].lower[0]", -0.40, "found -0.4 for x"),
    ("task.waypoints", [], "waypoint"),
    ("task.waypoints[0].fixed", ZERO_POSE, "'lower'"),
    ("task.waypoints[0].count", 97, "found 101 ", "task.waypoints"),
    ("task.waypoints[0]", {"lower": ZERO_POSE, "upper": ZERO_POSE}, "fixed"),
    ("task.initial", [ZERO_POSE], "found 1 "),
    ("task.initial[1][2]", 1.2, "found 1.2 for z"),
    ("task.reference_speed", 1.5, "payload.velocity_max = 1"),
    (
        "task.allowed_contacts",
        [allowed(0.02, "tpo board")],
        "'top board'",
        "task.allowed_contacts[0].body",
    ),
    ("task.allowed_contacts", [allowed(20)], " mm", "task.allowed_contacts[0].departure"),
    ("task.start[2]", 2.5, "robot 'left'", "task.start"),
    ("robots[1].base.xyz[1]", -3.0, "robot 'right'", "task.goal"),
    # names
    ("environment[1].name", "ground", "environment[1].name", "environment[5].name"),
    ("robots[1].name", "left", "found 'left' "),
    ("environment[0].name", "payload", "reserved"),
    ("environment[0].name", "left", "robots[0].name"),
    ("environment[0].name", "a\u202eb", "control"),
    ("environment[0].name", " a", "spaces"),
    ("environment[0].name", "a" * 81, "81 characters"),
    ("environment[0].name", 5, "text"),
    ("environment[0].name", "left/link_1", "without '/'"),
    ("robots[0].tool[0].name", "link_3", "gofa12.urdf"),
    # robots
    ("robots[0].urdf", "nowhere.urdf", "nowhere.urdf"),
    ("robots[0].urdf", "a\0b", "path"),
    ("robots[0].urdf", "x" * 5000, os.strerror(errno.ENAMETOOLONG)),
    ("robots[0].urdf", str(RACK), "not readable XML"),
    ("robots[0].flange", "tool", "'tool0'"),
    ("robots[0].flange", "link_4", "last joint"),
    ("robots[0].locked_joints.joint_9", 0.0, "'joint_9'", "robots[0].locked_joints"),
    ("robots[0].locked_joints.joint_6", 0.0, "found 5 ", "robots[0].urdf"),
    ("robots[0].package_dirs", ["nowhere"], "folder", "robots[0].package_dirs[0]"),
    ("robots[0].package_dirs", ["x" * 5000], "folder", "robots[0].package_dirs[0]"),
    (
        "robots[0].position_lower",
        LOWER,
        "'joint_3'",
        "robots[0].position_lower[2]",
    ),
    # other files, collision pairs
    ("environment[0]", NO_MESH, "no.stl", "environment[0].path"),
    (
        "collision.ignored",
        [ignored("left/link_7")],
        "'left/",
        "collision.ignored[0].second",
    ),
    ("collision.ignored", [ignored("payload")], "itself", "collision.ignored[0]"),
]


def problems_of(path: Path) -> list[str]:
    with pytest.raises(WorkcellError) as caught:
        load(path)
    assert str(path) in str(caught.value)
    assert all(problem in str(caught.value) for problem in caught.value.problems)
    return list(caught.value.problems)


def keys_of(problems: list[str]) -> list[str]:
    return [problem.partition(": ")[0] for problem in problems]


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
        assert len(problem) < 1200, problem


def test_one_mistake_is_one_problem(tmp_path: Path) -> None:
    data = sample_data()
    put(data, "payload.size[0]", 300)
    put(data, "contacts[0].spin", 45)
    found = problems_of(write(tmp_path, data))
    assert [problem.split(":")[0] for problem in found] == ["payload.size[0]", "contacts[0].spin"]


def test_a_missing_section_does_not_blame_others(tmp_path: Path) -> None:
    data = sample_data()
    del data["payload"]
    assert keys_of(problems_of(write(tmp_path, data))) == ["payload"]


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
    assert keys_of([told]) == ["environment"]
    assert all(word in told for word in ("2000", "2041", "collision.most_pieces"))
    data["collision"]["most_pieces"] = 2041
    assert len(load(write(tmp_path, data)).environment) == 2000


def test_thousands_of_unknown_keys_are_counted(tmp_path: Path) -> None:
    data = sample_data() | {f"unknown_{k}": 1 for k in range(20_000)}
    with soon():
        found = problems_of(write(tmp_path, data))
    assert len(found) == 11
    assert keys_of(found[-1:]) == ["file"]
    assert "19990" in found[-1]


def test_thousands_of_problems_are_counted(tmp_path: Path) -> None:
    data = sample_data()
    data["environment"] = [{"name": 1} for _ in range(300)]
    found = problems_of(write(tmp_path, data))
    assert len(found) == 101
    assert found[-1].startswith("and ")


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
    words = {"large": "(100 MiB)"}.get(kind, f" {kind})")
    assert first.startswith("robots[0].urdf: ")
    assert second.startswith("environment[0].path: ")
    assert words in first
    assert words in second
    assert words in problems_of(odd)[0]


@pytest.mark.parametrize(
    ("content", "code", "quoted"),
    [(b"name = ", "not-toml", "file: "), (b"", "workcell", "name: ")],
)
def test_unusable_files(tmp_path: Path, content: bytes, code: str, quoted: str) -> None:
    path = tmp_path / "cell.toml"
    path.write_bytes(content)
    with refused(WorkcellError, code, quoted):
        load(path)


REVOLUTE, BOX = '"joint_4" type="revolute"', '<box size="0.161 0.093 0.707"/>'
FAR = f'<mesh filename="package://{"a/" * 50}link.stl"/>'


@pytest.mark.parametrize(
    ("old", "new", "key", "words"),
    [
        ("<robot", "<a><robot", "urdf", "XML"),
        ("robot", "arm", "urdf", "<arm>"),
        (REVOLUTE, REVOLUTE.replace("revolute", "planar"), "urdf", "'joint_4'"),
        ('parent link="link_5"', 'parent link="link_4"', "urdf", "follow"),
        ('effort="390"', 'effort="0"', "torque_max", "joint 1"),
        ('upper="1.483529864195180"', 'upper="-5"', "position_lower[2]", "-5 rad"),
        (BOX, '<mesh filename="package://a/b.stl"/>', "urdf", "'package://a/b.stl'"),
        (BOX, FAR, "urdf", "a/a/a/link.stl'"),
    ],
)
def test_unusable_urdf(tmp_path: Path, old: str, new: str, key: str, words: str) -> None:
    text = GOFA.read_text(encoding="utf-8")
    assert old in text
    (tmp_path / "arm.urdf").write_text(text.replace(old, new), encoding="utf-8")
    data = sample_data()
    data["robots"][0]["urdf"] = "arm.urdf"
    found = problems_of(write(tmp_path, data))
    assert any(p.startswith(f"robots[0].{key}: ") and words in p for p in found), found


def test_further_checks_run_on_a_valid_cell_only(tmp_path: Path) -> None:
    seen: list[str] = []

    def no_solution(workcell: Workcell) -> list[str]:
        seen.append(workcell.name)
        return ["task.start: no joint angles reach it; allowed is a pose within reach"]

    with pytest.raises(WorkcellError, match=r"task\.start: "):
        load(RACK, checks=[no_solution])
    data = sample_data()
    put(data, "payload.mass", -1)
    with pytest.raises(WorkcellError, match=r"payload\.mass"):
        load(write(tmp_path, data), checks=[no_solution])
    assert len(seen) == 1


def test_soft_fingers_ask_for_pads_that_nearly_face_one_another(tmp_path: Path) -> None:
    """Of friction times the distance, 1.0 and 0.4 m, 0.9 are 0.36 m."""
    data = sample_data()
    put(data, "payload.size", [0.9, 0.4, 0.25])
    put(data, "task.allocation", "soft-finger")
    put(data, "contacts[1].xyz", [0.35, -0.20, 0.0])
    assert load(write(tmp_path, data)).task.allocation == "soft-finger"
    put(data, "contacts[1].xyz", [0.37, -0.20, 0.0])
    (found,) = problems_of(write(tmp_path, data))
    assert keys_of([found]) == ["contacts[1].xyz"]
    assert "0.37 m" in found
    put(data, "task.allocation", "paper")
    assert load(write(tmp_path, data)).task.allocation == "paper"
