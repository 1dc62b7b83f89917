"""Baxter before bookshelves, MotionBenchMaker's scenes as VAMP ships them, with a box of our own.

The files are those of github.com/KavrakiLab/vamp at commit f6de6a7, `resources/baxter`: 600 scenes
each of `bookshelf_tall_both_arms_easy`, `_medium` and `_hard`, the request of each with the joints
in which both arms begin and end. There each hand reaches for a can of its own, the two always on
different boards, so that no box is between both hands in the end. Here the box begins ahead of the
machine, in the middle between both hands of theirs; it ends at the edge of the board that the left
hand reaches over, abreast of the middle between both, and the cans of that board are put away.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from studies.research.benchmarks.measuring import (
    Benchmark,
    BenchmarkSource,
    BenchmarkTask,
    carry_problem,
)
from symbolic import safe_io
from symbolic.array import Array
from symbolic.errors import OutsideError
from symbolic.read.scenes import read_message, read_scene

RESOURCES = Path("vamp/resources/baxter")

CLONE_COMMANDS = f"""\
git clone https://github.com/KavrakiLab/vamp FOLDER/vamp
git -C FOLDER/vamp checkout f6de6a7
tar -xjf FOLDER/{RESOURCES}/problems.tar.bz2 -C FOLDER/{RESOURCES}"""

DIFFICULTIES = ("easy", "medium", "hard")

SCENES = 600
"""Number of published scenes of each kind."""

CAN_BOX = (0.10, 0.20, 0.10)
"""Edges of the carried box [m]; it is a little lower than a can."""

BEFORE = (0.70, 0.10)
"""Distance of the box's start ahead of the machine, and height above the shoulders' frame [m]."""

CLEARED = 0.2
"""Largest height of a can's middle above a board with which the can counts as standing on it
[m]."""

AIR = 0.01
"""Gap between a board and the box that stands on it [m]."""

PADDLE = (0.06, 0.03, 0.17)
"""Paddle in place of each gripper, as long; its flat side presses: width, thickness, length [m]."""

BAXTER_PAD = 0.14
"""Distance from a hand to the middle of its pad, on that side [m]."""

BAXTER_NOTE = (
    "Published (arXiv 2309.14545): each arm to a can of its own, nothing held, no path of a box; "
    "times and rates there are of motions of free arms."
)


def source(count: int, seed: int) -> BenchmarkSource:
    """Return the source of a benchmark with a random sample of the published scenes.

    Args:
        count: number of scenes of each kind.
        seed: seed of the sample.
    """

    def benchmark(there: Path) -> Benchmark:
        tasks, rng = [], np.random.default_rng(seed)
        safe_io.require(there / "baxter.urdf", safe_io.URDF_BYTES)
        hands = Hands(there / "baxter.urdf")
        for kind in DIFFICULTIES:
            scenes = there / "problems" / f"bookshelf_tall_both_arms_{kind}_baxter"
            chosen = np.sort(rng.choice(SCENES, count, replace=False) + 1).tolist()
            tasks += [_task(there, scenes, f"{kind} {k}", k, hands) for k in chosen]
        return Benchmark("baxter", "Baxter before bookshelves", tuple(tasks), BAXTER_NOTE)

    return BenchmarkSource(CLONE_COMMANDS, RESOURCES, benchmark)


class Hands:
    """Forward kinematics of Baxter's two hands."""

    def __init__(self, urdf: Path) -> None:
        self._model = pin.buildModelFromUrdf(str(urdf))
        self._data = self._model.createData()

    def at(self, joints: dict[str, float]) -> tuple[Array, Array]:
        """Return the positions (3,) [m] of the left and the right hand in the robot's root.

        Args:
            joints: joint positions [rad] by name; other joints are at their neutral position.
        """
        q = pin.neutral(self._model)
        for name, value in joints.items():
            if self._model.existJointName(name):
                q[self._model.joints[self._model.getJointId(name)].idx_q] = value
        pin.framesForwardKinematics(self._model, self._data, q)
        frames = [self._model.getFrameId(f"{side}_hand", pin.BODY) for side in ("left", "right")]
        left, right = (self._data.oMf[frame].translation.copy() for frame in frames)
        return left, right


def request(path: Path) -> tuple[dict[str, float], dict[str, float]]:
    """Read the first and the last posture of both arms from a scene's request file.

    Returns:
        Joint positions [rad] by name, first at the beginning, then at the end.

    Raises:
        OutsideError: the file is not such a request.
    """
    data = read_message(path)
    try:
        start = data["start_state"]["joint_state"]
        goal = data["goal_constraints"][0]["joint_constraints"]
        return (
            {str(name): float(q) for name, q in zip(start["name"], start["position"], strict=True)},
            {str(one["joint_name"]): float(one["position"]) for one in goal},
        )
    except (KeyError, TypeError, IndexError, ValueError) as error:
        raise OutsideError("the request lacks start and goal joints") from error


def _task(there: Path, scenes: Path, name: str, number: int, hands: Hands) -> BenchmarkTask:
    joints = request(scenes / f"request{number:04d}.yaml")
    start, goal = (hands.at(one) for one in joints)
    bodies = read_scene(scenes / f"scene{number:04d}.yaml").tables(scenes, scenes)
    boards = [body for body in bodies if body["name"].startswith("shelf")]
    board = max(
        (one for one in boards if one["xyz"][2] < goal[0][2]), key=lambda one: float(one["xyz"][2])
    )
    top = board["xyz"][2] + board["size"][2] / 2.0
    begins = [BEFORE[0], (start[0][1] + start[1][1]) / 2.0, BEFORE[1]]
    ends = [
        board["xyz"][0] - board["size"][0] / 2.0 + CAN_BOX[0] / 2.0,
        (goal[0][1] + goal[1][1]) / 2.0,
        top + CAN_BOX[2] / 2.0 + AIR,
    ]
    cleared = [
        body
        for body in bodies
        if not (body["name"].startswith("Can") and top < body["xyz"][2] < top + CLEARED)
    ]
    problem = carry_problem(
        f"Baxter, {name}",
        [_robot(there, side) for side in ("left", "right")],
        {"size": list(CAN_BOX), "mass": 1.0},
        [{"patch_radius": 0.03}] * 2,
        (_upright(begins), _upright(ends)),
        cleared,
        reference_speed=0.2,
        reference_force=30.0,
    )
    return BenchmarkTask(name, problem)


def _upright(xyz: list[float]) -> list[float]:
    return [*np.round(xyz, 4).tolist(), 0.0, 0.0, 0.0]


def _robot(there: Path, side: str) -> dict[str, Any]:
    paddle = {"kind": "box", "size": list(PADDLE), "xyz": [0.0, 0.0, PADDLE[2] / 2.0]}
    return {
        "name": side,
        "urdf": str((there / "baxter.urdf").resolve()),
        "srdf": str((there / "baxter.srdf").resolve()),
        "chain": ["base", f"{side}_hand"],
        "drop_links": [f"{side}_gripper_base"],
        "base": {"xyz": [0.0, 0.0, 0.0]},
        "pad": {"xyz": [0.0, PADDLE[1] / 2.0, BAXTER_PAD], "rpy": [-np.pi / 2.0, 0.0, 0.0]},
        "min_manipulability": 0.002,
        "tool": [{"name": "paddle", **paddle}],
    }
