"""Two Pandas roll a plate under a gate and set it into a slot.

The scene is that of github.com/haot1an/dual-arm-cooperative-manipulation at commit ed943f0,
`models/scene_slot_gate.xml`; its task stands in `config/scenes/slot_gate.yaml`, its arms' places in
`models/workcell.xml`, their joints' ranges and torques in `models/panda_hand_torque.xml`, speeds,
accelerations and margins in `config/default.yaml`. There fingers grip the plate's short edges, and
are welded to it; here pads press on these edges from both ends. The arms are those of
`example-robot-data`.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from studies.research.benchmarks.measuring import (
    Benchmark,
    BenchmarkSource,
    BenchmarkTask,
    carry_problem,
)
from symbolic import safe_io
from symbolic.errors import OutsideError
from symbolic.read.elements import parse_elements

PLATE = (0.6, 0.2, 0.02)

SLOT_START = [0.0, -0.45, 0.876, 0.0, 0.0, 0.0]
GOAL = [0.0, -0.65, 1.051, -np.pi / 2.0, 0.0, 0.0]
"""Poses of the plate on the riser and in the slot, each with a millimetre of air below [m, rad]."""

ARM_PLACES = {"left": (0.375, -105.0), "right": (-0.375, -75.0)}
"""Position along x [m] and yaw [degrees] of both arms on the table."""

SLOT_TABLE = {"name": "table", "kind": "box", "size": [1.7, 1.3, 0.04], "xyz": [0.0, -0.35, 0.7299]}

SLOT_PAD = 0.0934
"""Distance from the flange to the plate's edge, which their grip overlaps by 10 mm [m]."""

HAND = 0.76
"""Mass of a hand with its fingers [kg]."""

SPEED_LIMITS: tuple[tuple[str, dict[str, float], float], ...] = (
    ("joint limits", {}, 7.60),
    (
        "plate at 0.12 m/s",
        {"velocity_max": 0.12, "acceleration_max": 0.3, "angular_velocity_max": 0.6},
        7.60,
    ),
    (
        "plate at 0.08 m/s",
        {"velocity_max": 0.08, "acceleration_max": 0.2, "angular_velocity_max": 0.6},
        8.96,
    ),
)
"""Limits besides those of the arms, each with the published time to the goal [s]. The published
planner limits the plate's speed in both cases."""

JOINTS = {
    "position_lower": [-2.7973, -1.6628, -2.7973, -2.9718, -2.7973, 0.0825, -2.7973],
    "position_upper": [2.7973, 1.6628, 2.7973, -0.1698, 2.7973, 3.6525, 2.7973],
    "velocity_max": [2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61],
    "acceleration_max": [15.0, 15.0, 15.0, 15.0, 20.0, 20.0, 20.0],
    "torque_max": [86.5, 86.5, 86.5, 86.5, 11.5, 11.5, 11.5],
}
"""Limits of their planner and controller, which stay 0.1 rad and 0.5 N m inside those of their
model [rad, rad/s, rad/s^2, N m]."""

SLOT_NOTE = (
    "Published (docs/trajectory_planning.md there): 15.49 s along straight lines and turns one "
    "after the other; 7.60 s with path and time optimised together, the plate at 0.12 m/s at most, "
    "8.96 s at 0.08 m/s as before; 3.6 s of planning; 7 N of internal force undisturbed, 36 N at "
    "most. These times are simulated, with a controller that follows the plan, and begin with a "
    "second of rest; the plan keeps 20 mm of air. Fingers are welded to the plate there; here "
    "friction holds it."
)


def benchmark(there: Path) -> Benchmark:
    """Return the benchmark made from the published files in a folder: one carry within three sets
    of limits."""
    content = safe_io.read_bytes(there / "models/scene_slot_gate.xml", safe_io.URDF_BYTES)
    scene = [SLOT_TABLE, *bodies(safe_io.text(content))]
    tasks = []
    for name, limits, seconds in SPEED_LIMITS:
        problem = carry_problem(
            f"Plate through a gate, {name}",
            [_robot(arm) for arm in ARM_PLACES],
            {"size": list(PLATE), "mass": 1.2, **limits},
            [
                {"xyz": [side * PLATE[0] / 2.0, 0.0, 0.0], "patch_radius": 0.009}
                for side in (1.0, -1.0)
            ],
            (SLOT_START, GOAL),
            scene,
            reference_speed=0.08,
            reference_force=30.0,
        )
        tasks.append(BenchmarkTask(name, problem, seconds=seconds))
    return Benchmark("slot", "Two Pandas and a slot behind a gate", tuple(tasks), SLOT_NOTE)


def bodies(scene: str) -> Iterator[dict[str, Any]]:
    """Yield the fixed boxes of a published scene as bodies of a workcell file, one dictionary each.

    Raises:
        OutsideError: the text is not such a scene.
    """
    found = 0
    for body in parse_elements(scene, "mujoco").iterfind("worldbody/body"):
        if body.find("freejoint") is not None:
            continue
        at = np.array(_numbers(body.get("pos")))
        for geom in body.iterfind("geom"):
            half, offset = _numbers(geom.get("size")), _numbers(geom.get("pos", "0 0 0"))
            found += 1
            yield {
                "name": geom.get("name", f"body {found}"),
                "kind": "box",
                "size": [2.0 * value for value in half],
                "xyz": (at + offset).tolist(),
            }
    if not found:
        raise OutsideError("the scene has no bodies that stand")


def _numbers(text: str | None) -> list[float]:
    """Parse the three numbers in the text of an XML attribute."""
    try:
        found = [float(each) for each in (text or "").split()]
    except ValueError:
        found = []
    if len(found) != 3:
        raise OutsideError(f"the scene has {text!r} where three numbers belong")
    return found


def _robot(name: str) -> dict[str, Any]:
    x, yaw = ARM_PLACES[name]
    return {
        "name": name,
        "urdf": "package://example-robot-data/robots/panda_description/urdf/panda.urdf",
        "chain": ["panda_link0", "panda_link8"],
        "drop_links": ["panda_hand"],
        "base": {"xyz": [x, 0.0, 0.75], "rpy": [0.0, 0.0, float(np.radians(yaw))]},
        "pad": {"xyz": [0.0, 0.0, SLOT_PAD]},
        **JOINTS,
        "tool_load": {"mass": HAND, "centre_of_mass": [0.0, 0.0, 0.03]},
        "tool": [
            {
                "name": "hand",
                "kind": "box",
                "size": [0.06, 0.2, 0.07],
                "xyz": [0.0, 0.0, 0.035],
                "rpy": [0.0, 0.0, -np.pi / 4.0],
            },
            {
                "name": "pad",
                "kind": "cylinder",
                "radius": 0.009,
                "length": SLOT_PAD - 0.07,
                "xyz": [0.0, 0.0, (SLOT_PAD + 0.07) / 2.0],
            },
        ],
    }


SLOT_SOURCE = BenchmarkSource(
    """\
git clone https://github.com/haot1an/dual-arm-cooperative-manipulation FOLDER/slot
git -C FOLDER/slot checkout ed943f0""",
    Path("slot"),
    benchmark,
)
