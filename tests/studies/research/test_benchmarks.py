"""Other people's benchmarks, from a folder laid out as theirs, with an arm of its dimensions."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from scipy.optimize import fsolve
from scipy.spatial.transform import Rotation

import hybrid_opt as ho
from hybrid_opt.display.table import NOTHING
from hybrid_opt.extras.proposing.problem import read_problem
from hybrid_opt.extras.proposing.via_points import path_length
from studies.research.benchmarks import baxter, machines, measuring, shelves, slot
from studies.research.benchmarks.__main__ import main
from studies.research.benchmarks.measuring import (
    BenchmarkSource,
    Length,
    TaskResult,
    checks_per_second,
    measured,
    solved,
    table,
)
from symbolic.errors import SettingsError
from symbolic.read.editing import completed
from tests.refusals import ended_by
from tests.symbolic.cells import RACK

RNG = np.random.default_rng(1)

POSTURES = {
    "bottom": [-0.6431, 1.9156, -1.7968, 1.2945, -0.0238, -0.8770, -1.7042, 1.45],
    "middle": [-0.5997, 1.4898, -1.4740, 1.2905, -0.0442, -0.8794, -1.1603, 1.45],
    "top": [-0.1995, 0.9141, -2.2366, 0.5239, 0.7998, -1.3575, -1.0153, 2.41],
}
"""Those of the notebook at commit aca3cbd, to four digits [rad]."""

HEIGHTS = (0.15, 0.21, 0.2, 0.22, 0.2, 0.2, 0.081)
"""Of an iiwa 14's joints above the one before [m]."""

AXES = ("0 0 1", "0 1 0", "0 0 1", "0 -1 0", "0 0 1", "0 1 0", "0 0 1")


def arm() -> str:
    """URDF of an arm with an iiwa 14's joints, a small ball on every link."""
    inertia = '<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/>'
    ball = '<collision><geometry><sphere radius="0.05"/></geometry></collision>'
    parts = ['<link name="base"/>']
    for k, (height, axis) in enumerate(zip(HEIGHTS, AXES, strict=True), 1):
        before = "base" if k == 1 else f"iiwa_link_{k - 1}"
        parts.append(
            f'<link name="iiwa_link_{k}"><inertial><mass value="3"/>{inertia}</inertial>{ball}'
            f'</link><joint name="iiwa_joint_{k}" type="revolute"><parent link="{before}"/>'
            f'<child link="iiwa_link_{k}"/><origin xyz="0 0 {height}"/><axis xyz="{axis}"/>'
            '<limit lower="-3" upper="3" velocity="1.5" effort="200"/></joint>'
        )
    return f'<robot name="iiwa14">{"".join(parts)}</robot>'


def scene(name: str, size: str, height: float) -> str:
    return (
        f'<sdf version="1.7"><model name="{name}"><link name="body"><collision name="{name}">'
        f"<pose>0 0 {height} 0 0 0</pose><geometry><box><size>{size}</size></box></geometry>"
        "</collision></link></model></sdf>"
    )


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Laid out as their repository."""
    models = tmp_path / "bimanual" / "models"
    lines = [f"q_tilde_{name} = np.array({q})\n" for name, q in POSTURES.items()]
    cells = [{"cell_type": "markdown", "source": ["text"]}, {"source": lines}]
    written = {
        models.parent / "notebooks" / "main.ipynb": json.dumps({"cells": cells}),
        models / "iiwa14_convex_decimated_collision.urdf": arm(),
        models / "old_table" / "table_wide.sdf": scene("table_top", "5 5 0.2", -0.1),
        models / "old_shelves.sdf": scene("shelf", "0.4 1.0 0.014", 0.3),
    }
    for path, text in written.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    return tmp_path


GATE = """<mujoco><include file="workcell.xml"/><worldbody>
<body name="slot" pos="0 -0.65 0.75"><geom name="base" size="0.32 0.07 0.1" pos="0 0 0.1"/>
<geom name="wall" size="0.32 0.025 0.025" pos="0 -0.045 0.225"/></body>
<body name="gate" pos="0 -0.465 1.385"><geom name="gate" type="box" size="0.32 0.015 0.215"/></body>
<body name="plate" pos="0 -0.45 0.876"><freejoint/><geom size="0.3 0.1 0.01"/></body>
</worldbody></mujoco>"""

SLOT = "models/scene_slot_gate.xml"


def test_the_shelves_become_problems_of_this_project(folder: Path) -> None:
    given = shelves.SHELVES_SOURCE.benchmark(folder)
    assert [task.name for task in given.tasks] == [
        "top to middle",
        "middle to bottom",
        "bottom to top",
    ]
    places = {"bottom": [0.6, 0.4, 0.1], "middle": [0.65, 0.4, 0.44], "top": [0.7, 0.4, 0.73]}
    for task in given.tasks:
        start, goal = task.name.split(" to ")
        path = folder / "problem.toml"
        path.write_text(completed("", {}, task.problem), encoding="utf-8")
        poses = np.array(read_problem(path).poses)
        np.testing.assert_allclose(poses[:, :3], [places[start], places[goal]], atol=2e-3)
        apart = np.subtract(POSTURES[goal], POSTURES[start])
        assert task.straight == pytest.approx(np.sqrt(apart @ apart))
    by_name = {body["name"]: body["xyz"] for body in given.tasks[0].problem["environment"]}
    np.testing.assert_allclose(by_name["table_top body table_top"], [0.4, 0.3825, -0.1])
    np.testing.assert_allclose(by_name["shelf body shelf"], [0.8, 0.3825, 0.3])


def test_the_elbow_turns_about_shoulder_and_wrist() -> None:
    """Turn the elbow by SciPy, find joints that reach it, and see them turned by as much."""
    model = pin.buildModelFromXML(arm())
    data = model.createData()

    def bend(q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        pin.forwardKinematics(model, data, np.concatenate([q, np.zeros(7 - len(q))]))
        found = [data.oMi[k].translation.copy() for k in (2, 4, 6)]
        return found[0], found[1], found[2]

    q = np.array([0.4, 0.7, -0.3, -1.2])
    shoulder, elbow, wrist = bend(q)
    line = (wrist - shoulder) / np.linalg.norm(wrist - shoulder)
    for angle in (-0.4, 0.1, 0.5):
        there = shoulder + Rotation.from_rotvec(angle * line).apply(elbow - shoulder)

        def missed(some: np.ndarray, there: np.ndarray = there) -> np.ndarray:
            _, now, hand = bend(some)
            return np.array([*(now - there)[:2], *(hand - wrist)[:2]])

        turned = fsolve(missed, q, xtol=1e-13)
        np.testing.assert_allclose(bend(turned)[2], wrist, atol=1e-9)
        wider = [np.concatenate([each, np.zeros(3)]) for each in (q, turned)]
        by = shelves.elbow_turn(wider[1]) - shelves.elbow_turn(wider[0])
        assert by == pytest.approx(angle, abs=1e-8)
        path = shelves.coordinates(np.zeros((2, 7)), np.array(wider))
        assert path_length(path) == pytest.approx(abs(angle), abs=1e-8)


@pytest.mark.parametrize(
    ("source", "file", "text", "told"),
    [
        (shelves.SHELVES_SOURCE, "notebooks/main.ipynb", "{", "main.ipynb "),
        (shelves.SHELVES_SOURCE, "notebooks/main.ipynb", '{"cells": 3}', "main.ipynb "),
        (
            shelves.SHELVES_SOURCE,
            "notebooks/main.ipynb",
            '{"cells": [{"source": ["q_tilde_top = np.array([1])"]}]}',
            "main.ipynb ",
        ),
        (shelves.SHELVES_SOURCE, "notebooks/other.ipynb", "{}", "bimanual"),
        (slot.SLOT_SOURCE, SLOT, "<mujoco><worldbody/></mujoco>", "bodies"),
        (slot.SLOT_SOURCE, SLOT, GATE.replace("0.32 0.07 0.1", "0.32 x"), "0.32 x"),
        (slot.SLOT_SOURCE, SLOT, "<mujoco", "slot"),
        (machines.MACHINES_SOURCE, "none", "", "dual_ur10e.urdf"),
        (baxter.source(1, 3), "none", "", "baxter: "),
    ],
)
def test_what_is_not_theirs_is_refused(
    source: BenchmarkSource, file: str, text: str, told: str, tmp_path: Path
) -> None:
    path = tmp_path / source.room / file
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    with pytest.raises(SettingsError, match=rf"(?s){told}.*\ngit clone"):
        source.benchmark(tmp_path)


def test_the_program_says_how_to_get_files(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    assert "git clone" in capsys.readouterr().out
    with ended_by("unknown-name", "'shelfs'", "shelves", "baxter"):
        assert main(["shelfs"]) == 2


def test_a_task_without_a_carry_says_why(folder: Path) -> None:
    given = shelves.SHELVES_SOURCE.benchmark(folder)
    task = given.tasks[0]
    task.problem["task"]["goal"][2] = 0.3
    task = replace(task, name="top to middle, 0.1 m/s")  # no folder of that name
    found = measured(given, task, folder / "out", ho.ProposeSettings(), 1, study=False)
    assert re.search("payload .*shelf body shelf .*goal", found.refused)
    assert found.refused in table(given, [found], RNG).note


def test_the_table_has_figures_where_there_are_some(folder: Path) -> None:
    given = shelves.SHELVES_SOURCE.benchmark(folder)
    some = TaskResult(given.tasks[0], "", True, None, 12.0, 20.0, Length(3.0, 2.1))
    rows = table(given, [some], RNG).rows
    assert rows[0][:7] == ("top to middle", "12.0", "20.0", "3.00", "2.10", "1.88", "2.09")
    assert rows[0][7:] == (NOTHING,) * 6
    studied = replace(some, fastest=Length(3.2, 2.2), shortest=Length(2.8, 2.0))
    assert table(given, [studied], RNG).rows[0][10:] == ("2.20", "2.00", "2.80")
    told = solved([some, TaskResult(given.tasks[1], "out of reach", False)])
    assert re.findall(r"\d+", told)[:3] == ["2", "1", "1"]


def test_machines_are_problems_whose_box_stands_clear_of_the_post(tmp_path: Path) -> None:
    for file in (machines.UR10E, machines.PANDAS):
        (tmp_path / file).parent.mkdir(parents=True)
        (tmp_path / file).touch()
    given = machines.MACHINES_SOURCE.benchmark(tmp_path)
    assert len(given.tasks) == 4
    for task in given.tasks:
        half = np.array(task.problem["payload"]["size"]) / 2.0
        post = next(body for body in task.problem["environment"] if body["name"] == "post")
        for end in ("start", "goal"):
            apart = np.abs(np.subtract(task.problem["task"][end][:3], post["xyz"]))
            assert np.any(apart > half + np.array(post["size"]) / 2.0 + 0.01)
        ends = [task.problem["task"][end][0] for end in ("start", "goal")]
        assert post["xyz"][0] == pytest.approx(np.mean(ends)), "in between"


SCENE = """
world:
  collision_objects:
    - {id: Can1, primitives: [{type: cylinder, dimensions: [0.14, 0.03]}],
       primitive_poses: [{position: [0.9, 0.1, 0.11], orientation: [0, 0, 0, 1]}]}
    - {id: Can2, primitives: [{type: cylinder, dimensions: [0.14, 0.03]}],
       primitive_poses: [{position: [0.9, 0.1, 0.41], orientation: [0, 0, 0, 1]}]}
    - {id: shelf_low, primitives: [{type: box, dimensions: [1.2, 1, 0.04]}],
       primitive_poses: [{position: [1.4, 0.0, 0.02], orientation: [0, 0, 0, 1]}]}
    - {id: shelf_high, primitives: [{type: box, dimensions: [1.2, 1, 0.04]}],
       primitive_poses: [{position: [1.4, 0.0, 0.32], orientation: [0, 0, 0, 1]}]}
"""


def test_baxters_box_ends_on_the_board_that_the_left_hand_reaches_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Hands on slides, the joints as the request says; the board's cans are put away."""
    slides = "".join(
        f'<link name="{side}_hand"/><joint name="{side}_{axis}" type="prismatic">'
        f'<parent link="base"/><child link="{side}_hand"/><axis xyz="0 1 0"/>'
        f'<origin xyz="0.8 0 {height}"/><limit lower="-2" upper="2" velocity="1" effort="1"/>'
        "</joint>"
        for side, axis, height in (("left", "s0", 0.12), ("right", "s0", 0.43))
    )
    there = tmp_path / baxter.RESOURCES
    scenes = there / "problems" / "bookshelf_tall_both_arms_easy_baxter"
    scenes.mkdir(parents=True)
    (there / "baxter.urdf").write_text(f'<robot name="b"><link name="base"/>{slides}</robot>')
    start = "{name: [left_s0, right_s0, head], position: [0.5, -0.3, 0]}"
    goal = "[{joint_name: left_s0, position: 0.2}, {joint_name: right_s0, position: 0.0}]"
    text = (
        f"start_state: {{joint_state: {start}}}\ngoal_constraints: [{{joint_constraints: {goal}}}]"
    )
    (scenes / "request0001.yaml").write_text(text)
    (scenes / "scene0001.yaml").write_text(SCENE)
    monkeypatch.setattr(baxter, "SCENES", 1)
    monkeypatch.setattr(baxter, "DIFFICULTIES", ("easy",))
    (task,) = baxter.source(1, 3).benchmark(tmp_path).tasks
    begins, ends = (task.problem["task"][end][:3] for end in ("start", "goal"))
    np.testing.assert_allclose(begins, [baxter.BEFORE[0], 0.1, baxter.BEFORE[1]])
    np.testing.assert_allclose(ends, [0.8 + 0.05, 0.1, 0.04 + 0.05 + baxter.AIR], atol=1e-4)
    names = [body["name"] for body in task.problem["environment"]]
    assert names == ["Can2", "shelf_low", "shelf_high"]
    (scenes / "request0001.yaml").write_text("start_state: 3")
    with pytest.raises(SettingsError, match=r"(?s)git clone"):
        baxter.source(1, 3).benchmark(tmp_path)


def test_the_slot_becomes_a_problem_within_their_limits(tmp_path: Path) -> None:
    """MuJoCo says where the bodies are, Pinocchio that its own postures hold the plate's ends, and
    that the joints' limits are a margin inside those of the same arm's description."""
    mujoco = pytest.importorskip("mujoco")
    scene = tmp_path / "slot" / "models" / "scene_slot_gate.xml"
    scene.parent.mkdir(parents=True)
    scene.write_text(GATE, encoding="utf-8")
    given = slot.SLOT_SOURCE.benchmark(tmp_path)
    assert [task.seconds for task in given.tasks] == [7.60, 7.60, 8.96]
    model = mujoco.MjModel.from_xml_string(GATE.replace('<include file="workcell.xml"/>', ""))
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    table, *found = given.tasks[0].problem["environment"]
    assert table["xyz"][2] + table["size"][2] / 2.0 == pytest.approx(0.7499)
    assert [body["name"] for body in found] == ["base", "wall", "gate"]
    for k, body in enumerate(found):
        np.testing.assert_allclose(body["xyz"], data.geom_xpos[k])
        np.testing.assert_allclose(body["size"], 2.0 * model.geom_size[k])
    path = tmp_path / "problem.toml"
    path.write_text(completed("", {}, given.tasks[2].problem), encoding="utf-8")
    cell = read_problem(path).workcell({})
    assert cell.payload.velocity_max == 0.08
    panda = pin.buildModelFromUrdf(str(cell.robots[0].urdf))
    for robot in cell.robots:
        np.testing.assert_allclose(robot.position_lower, panda.lowerPositionLimit[:7] + 0.1)
        np.testing.assert_allclose(robot.position_upper, panda.upperPositionLimit[:7] - 0.1)
        np.testing.assert_allclose(robot.velocity_max, panda.velocityLimit[:7])
        np.testing.assert_allclose(robot.torque_max, panda.effortLimit[:7] - 0.5)
    for robot, contact, q in zip(cell.robots, cell.contacts, GRIPPING, strict=True):
        numbers = panda.createData()
        pin.framesForwardKinematics(panda, numbers, np.array([*q, 0.0, 0.0]))
        flange = robot.T_world_base @ numbers.oMf[panda.getFrameId("panda_link8")].homogeneous
        pad = flange @ np.array([0.0, 0.0, slot.SLOT_PAD, 1.0])
        np.testing.assert_allclose(
            pad[:3], np.add(slot.SLOT_START[:3], contact.T_box_pad[:3, 3]), atol=2e-4
        )


GRIPPING = (
    (0.82126, 0.609877, -0.273083, -2.2449, -1.20616, 1.61184, -1.12358),
    (-0.871891, 0.618396, 0.323701, -2.24691, 1.18778, 1.63681, -0.439111),
)
"""Postures that the scene's file states for the plate on its riser [rad]."""


def test_the_shortest_carry_is_shorter_than_the_one_it_began_with_and_certified(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(measuring, "SHORT_EVALUATIONS", 400)
    cell = ho.Cell.load(RACK)
    begin = cell.carry(cell.initial)
    found = measuring.shortest_carry(RACK, np.random.default_rng(1))
    ways = [path_length(np.hstack([arm.q for arm in carry.arms])) for carry in (begin, found)]
    assert ways[1] < 0.9 * ways[0]
    assert cell.certify(found).is_free
    assert ((found.x >= cell.workcell.task.lower) & (found.x <= cell.workcell.task.upper)).all()


def test_collision_checks_are_counted_by_work() -> None:
    rate = checks_per_second(Path("studies/workcells/rack.toml"), RNG)
    assert 100.0 < rate < 1e6  # measured: thousands
