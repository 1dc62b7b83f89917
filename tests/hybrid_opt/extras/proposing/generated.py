"""Problems of cells with random shelves, posts and goals."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from symbolic.read.editing import completed
from tests.machines import example_robot

UR10: dict[str, Any] = {
    "urdf": "ur_description/urdf/ur10_robot.urdf",
    "chain": ["base_link", "tool0"],
    "drop_links": [],
    "apart": 0.95,
    "size": [0.30, 0.40, 0.25],
    "mass": 6.0,
    "reach": 0.45,
    "height": 0.55,
    "force": 98.1,
    "pad": {"xyz": [0.0, 0.0, 0.10]},
    "tool": {"kind": "cylinder", "radius": 0.035, "length": 0.10, "xyz": [0.0, 0.0, 0.05]},
}
PANDA: dict[str, Any] = {
    "urdf": "panda_description/urdf/panda.urdf",
    "chain": ["panda_link0", "panda_link8"],
    "drop_links": ["panda_hand"],
    "apart": 0.72,
    "size": [0.20, 0.28, 0.16],
    "mass": 2.0,
    "reach": 0.28,
    "height": 0.35,
    "force": 30.0,
    "pad": {"xyz": [0.04, 0.0, 0.10], "rpy": [0.0, np.pi / 2.0, 0.0]},
    "tool": {"kind": "box", "size": [0.04, 0.09, 0.14], "xyz": [0.02, 0.0, 0.07]},
}
"""Arms of `example-robot-data`, and a cell that suits them: distance of each base from the middle,
edges and mass of the box, half the carry's length, and height of its start [m, kg]."""


def problem(seed: int) -> dict[str, Any]:
    """A problem's tables: even seeds have UR10, odd ones Pandas; posts, shelves or both."""
    rng = np.random.default_rng([14, seed])
    arm = (UR10, PANDA)[seed % 2]
    size = np.array(arm["size"])
    side = float(rng.choice([-1.0, 1.0]))
    start = np.array([-side * arm["reach"] * rng.uniform(0.8, 1.1), rng.uniform(-0.05, 0.05), 0.0])
    goal = np.array([side * arm["reach"] * rng.uniform(0.6, 1.1), rng.uniform(-0.08, 0.08), 0.0])
    start[2] = arm["height"] + rng.uniform(-0.05, 0.10)
    goal[2] = arm["height"] + rng.uniform(-0.05, 0.30)
    yaw = float(rng.uniform(-0.25, 0.25))
    environment = [_box("ground", (4.0, 4.0, 0.1), (0.0, 0.0, -0.06))]
    kind = seed // 2 % 3
    if kind in (0, 2):
        radius = float(rng.uniform(0.03, 0.07))
        top = float((start[2] + goal[2]) / 2.0 + rng.uniform(-0.05, 0.10))
        environment.append(
            {
                "name": "post",
                "kind": "cylinder",
                "radius": round(radius, 3),
                "length": round(top, 3),
                "xyz": [round(float(rng.uniform(-0.05, 0.05)), 3), 0.0, round(top / 2.0, 3)],
            }
        )
    if kind in (1, 2):
        for name, place in (("start", start), ("goal", goal)):
            gap = float(rng.uniform(0.01, 0.03))
            board = (size[0] + 0.06, size[1] - 0.10, 0.02)
            under = place - np.array([0.0, 0.0, size[2] / 2.0 + gap + 0.01])
            environment.append(_box(f"{name} board", board, under))
            if kind == 1:
                height = size[2] / 2.0 + float(rng.uniform(0.06, 0.12))
                over = place + np.array([0.0, 0.0, height])
                environment.append(_box(f"{name} cover", board, over))
                outer = np.sign(place[0])
                wall = place + np.array([outer * (size[0] / 2.0 + 0.05), 0.0, 0.0])
                environment.append(_box(f"{name} wall", (0.02, board[1], size[2]), wall))
    return {
        "name": f"Generated cell {seed}",
        "robots": [_robot(arm, 1.0), _robot(arm, -1.0)],
        "payload": {"size": arm["size"], "mass": arm["mass"]},
        "contacts": [
            {"xyz": [0.0, s * arm["size"][1] / 2.0, 0.0], "friction": 0.8, "patch_radius": 0.04}
            for s in (1.0, -1.0)
        ],
        "task": {
            "start": [*np.round(start, 4).tolist(), 0.0, 0.0, 0.0],
            "goal": [*np.round(goal, 4).tolist(), 0.0, 0.0, round(yaw, 4)],
            "reference_speed": 0.25,
            "reference_force": arm["force"],
        },
        "environment": environment,
    }


def _robot(arm: dict[str, Any], side: float) -> dict[str, Any]:
    return {
        "name": "north" if side > 0.0 else "south",
        "urdf": str(example_robot(arm["urdf"])),
        "chain": arm["chain"],
        "drop_links": arm["drop_links"],
        "base": {
            "xyz": [0.0, side * arm["apart"], 0.0],
            "rpy": [0.0, 0.0, -side * np.pi / 2],
        },
        "pad": arm["pad"],
        "tool": [{"name": "pad", **arm["tool"]}],
    }


def _box(name: str, size: Any, place: Any) -> dict[str, Any]:
    return {
        "name": name,
        "kind": "box",
        "size": [round(float(length), 4) for length in size],
        "xyz": [round(float(value), 4) for value in place],
    }


def write_problem(seed: int, folder: Path) -> Path:
    """The problem as a file."""
    path = folder / f"cell{seed:02d}.toml"
    path.write_text(completed("", problem(seed), {}), encoding="utf-8")
    return path
