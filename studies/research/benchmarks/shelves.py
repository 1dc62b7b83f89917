"""Two iiwa 14 carry between three shelves (Cohn, Shaw, Simchowitz and Tedrake, arXiv 2309.08770).

The files are those of github.com/cohnt/constrained-bimanual-planning-example at commit aca3cbd.
Its directives `models/old_shelves.dmd.yaml` say where things stand, its notebook in which postures
a carry begins and ends. There nothing is held: one gripper keeps its place in front of the other.
Here pads take the fingers' place, and hold a box no larger than the grippers' outline.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from pinocchio.utils import rotate

from studies.research.benchmarks.measuring import (
    Benchmark,
    BenchmarkSource,
    BenchmarkTask,
    carry_problem,
)
from symbolic import safe_io
from symbolic.array import Array
from symbolic.errors import OutsideError
from symbolic.read.scenes import read_scene

PACKAGE = "bimanual"
"""Name of the published files' folder in their URDF."""

BASE_DISTANCE = 0.765
"""Distance between both bases, along y [m]."""

GRASP = 0.6
"""Distance between both last links, along y [m]."""

STANDING = {
    "old_table/table_wide.sdf": np.array([0.4, 0.3825, 0.0]),
    "old_shelves.sdf": np.array([0.8, 0.3825, 0.0]),
}
"""Positions of the scene's models by their file [m]."""

SHELVES_PAD = 0.2
"""Distance from a last link to its pad: between palm and tip of their fingers [m]."""

SHELF_BOX = (0.12, GRASP - 2.0 * SHELVES_PAD, 0.12)

URDF_ACCELERATION = [8.57, 8.57, 8.74, 11.36, 12.23, 15.72, 15.72]
"""Accelerations as their URDF states them in an attribute of Drake's [rad/s^2]."""

UPPER_ARM, FOREARM = 0.42, 0.4
"""Distance from shoulder to elbow, and from elbow to wrist [m]."""

GRIPPER: dict[str, Any] = {
    "name": "gripper",
    "kind": "box",
    "size": [0.146, 0.0725, 0.05],
    "xyz": [0.0, 0.0, 0.040867],
    "rpy": [np.pi / 2.0, 0.0, np.radians(68.0)],
}
"""Shape of the gripper's palm, from the published SDF and its mounting in the directives."""

CARRIES = (
    ("top", "middle", 2.09),
    ("middle", "bottom", 3.32),
    ("bottom", "top", 5.62),
)
"""For each carry its first shelf, its last shelf, and the published length with IK-GCS [rad]."""

SHELVES_NOTE = (
    "Published: lengths of IK-GCS (arXiv 2309.08770), which plans in 2 to 3 s once regions are "
    "grown around postures chosen by hand; IK-BiRRT takes 49 to 54 s, Atlas-BiRRT 141 to 201 s. "
    "There both ends' postures are given, nothing is held, and no speed or force is planned; here "
    "postures are chosen, and a box is carried that has to stay held."
)


def benchmark(there: Path) -> Benchmark:
    """Return the benchmark of three carries made from the published files in a folder."""
    given = postures(safe_io.read_bytes(there / "notebooks/main.ipynb", safe_io.WORKCELL_BYTES))
    urdf = there / "models/iiwa14_convex_decimated_collision.urdf"
    model = pin.buildModelFromUrdf(str(urdf))
    poses = {name: _box(model, q[:7]) for name, q in given.items()}
    scene = _scene(there / "models")
    tasks = []
    for start, goal, length in CARRIES:
        problem = carry_problem(
            f"Shelves, {start} to {goal}",
            [
                _robot("left", urdf, there.parent, 0.0),
                _robot("right", urdf, there.parent, BASE_DISTANCE),
            ],
            {"size": list(SHELF_BOX), "mass": 2.0},
            [
                {"xyz": [0.0, side * SHELF_BOX[1] / 2.0, 0.0], "patch_radius": 0.03}
                for side in (-1.0, 1.0)
            ],
            (poses[start], poses[goal]),
            scene,
            reference_speed=0.25,
            reference_force=100.0,
        )
        straight = float(np.linalg.norm(given[goal] - given[start]))
        tasks.append(BenchmarkTask(f"{start} to {goal}", problem, length, straight))
    return Benchmark("shelves", "Two iiwa 14 and shelves", tuple(tasks), SHELVES_NOTE, coordinates)


def postures(notebook: bytes) -> dict[str, Array]:
    """Return the postures in the published notebook by shelf, in eight coordinates (8,): the left
    arm's joints, and the turn of the right arm's elbow about the line from shoulder to wrist [rad].

    Raises:
        OutsideError: the file is not a notebook with these postures.
    """
    try:
        cells = json.loads(notebook)["cells"]
        text = "\n".join("".join(cell["source"]) for cell in cells)
        found = re.findall(r"^q_tilde_(\w+) = np\.array\(\[([^]]*)\]\)", text, re.MULTILINE)
        given = {name: np.array([float(each) for each in row.split(",")]) for name, row in found}
    except (ValueError, KeyError, TypeError) as error:
        raise OutsideError("main.ipynb is no notebook of postures") from error
    if {q.shape for q in given.values()} != {(8,)} or not {"top", "middle", "bottom"} <= set(given):
        raise OutsideError("main.ipynb lacks the postures at the three shelves")
    return given


def coordinates(q_1: Array, q_2: Array) -> Array:
    """Convert joint positions of both arms to the eight published coordinates of `postures`.

    The elbow's angle is counted from the plane through the arm's first axis; it is meaningless if
    the wrist lies on this axis.

    Args:
        q_1, q_2: (n, 7) joint positions of the arms [rad].

    Returns:
        (n, 8) coordinates.
    """
    return np.column_stack([q_1, np.unwrap([elbow_turn(q) for q in q_2])])


def elbow_turn(q: Array) -> float:
    """Return the angle of an iiwa's elbow about the line from shoulder to wrist, for joints (7,)
    [rad]."""
    upper = rotate("z", q[0]) @ rotate("y", q[1])
    elbow = upper @ [0.0, 0.0, UPPER_ARM]
    wrist = elbow + upper @ rotate("z", q[2]) @ rotate("y", -q[3]) @ [0.0, 0.0, FOREARM]
    line = wrist / np.linalg.norm(wrist)
    across = np.cross(line, [0.0, 0.0, 1.0])
    return float(np.arctan2(elbow @ across, elbow @ np.cross(across, line)))


def _box(model: pin.Model, q: Array) -> list[float]:
    """Return the box pose [x, y, z, roll, pitch, yaw] [m, rad] at which the left arm holds the box.

    The last link must point along y.

    Args:
        model: Pinocchio's model of the left arm.
        q: (7,) joint positions [rad].
    """
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    hand = data.oMf[model.getFrameId("iiwa_link_7")]
    centre = hand.act(np.array([0.0, 0.0, GRASP / 2.0]))
    return [*np.round(centre, 3).tolist(), 0.0, 0.0, 0.0]


def _robot(name: str, urdf: Path, folder: Path, y: float) -> dict[str, Any]:
    start = float(GRIPPER["xyz"][2]) + 0.036
    return {
        "name": name,
        "urdf": str(urdf.resolve()),
        "package_dirs": [str(folder.resolve())],
        "chain": ["base", "iiwa_link_7"],
        "base": {"xyz": [0.0, y, 0.0], "rpy": [0.0, 0.0, 0.0]},
        "pad": {"xyz": [0.0, 0.0, SHELVES_PAD]},
        "acceleration_max": URDF_ACCELERATION,
        "tool": [
            GRIPPER,
            {
                "name": "pad",
                "kind": "cylinder",
                "radius": 0.03,
                "length": SHELVES_PAD - start,
                "xyz": [0.0, 0.0, (SHELVES_PAD + start) / 2.0],
            },
        ],
    }


def _scene(models: Path) -> list[dict[str, Any]]:
    """Return the table and the shelves as the bodies of a workcell file, one dictionary each.

    Args:
        models: folder of the meshes.
    """
    return [
        {**table, "xyz": (np.array(table["xyz"]) + at).tolist()}
        for name, at in STANDING.items()
        for table in read_scene(models / name).tables(models, models)
    ]


SHELVES_SOURCE = BenchmarkSource(
    f"""\
git clone https://github.com/cohnt/constrained-bimanual-planning-example FOLDER/{PACKAGE}
git -C FOLDER/{PACKAGE} checkout aca3cbd""",
    Path(PACKAGE),
    benchmark,
)
