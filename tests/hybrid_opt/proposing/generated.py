"""Problems of cells with random shelves, posts and goals, and what `ho.propose` makes of them.

    python -m tests.hybrid_opt.proposing.generated --cells 20 --time 60 --folder FOLDER

The time is the process's own, so that other work on the machine does not count. Whether a problem
can be solved at all is found by the same program with much more time (`--time`).
"""

from __future__ import annotations

import argparse
import resource
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import hybrid_opt as ho
from hybrid_opt.errors import ProposalError
from symbolic.read.editing import completed
from tests.machines import example_robot


@dataclass(frozen=True)
class ArmType:
    """An arm of `example-robot-data` and a cell's size that suits it.

    Attributes:
        urdf: path below the folder `robots`.
        chain: root and tip.
        drop: links that are left out.
        apart: distance of each base from the middle of the cell [m].
        size: edges of the box [m].
        mass: of the box [kg].
        reach: half of the length of the carry [m].
        height: of the box's centre at the start [m].
        force: reference force [N].
        pedestal: height of the bases [m].
        pad: its pose in the flange frame, and the tool's body.
    """

    urdf: str
    chain: tuple[str, str]
    drop: tuple[str, ...]
    apart: float
    size: tuple[float, float, float]
    mass: float
    reach: float
    height: float
    force: float
    pedestal: float
    pad: dict[str, list[float]]
    tool: dict[str, Any]


UR10 = ArmType(
    "ur_description/urdf/ur10_robot.urdf",
    ("base_link", "tool0"),
    (),
    0.95,
    (0.30, 0.40, 0.25),
    6.0,
    0.45,
    0.55,
    98.1,
    0.0,
    {"xyz": [0.0, 0.0, 0.10]},
    {"kind": "cylinder", "radius": 0.035, "length": 0.10, "xyz": [0.0, 0.0, 0.05]},
)
PANDA = ArmType(
    "panda_description/urdf/panda.urdf",
    ("panda_link0", "panda_link8"),
    ("panda_hand",),
    0.72,
    (0.20, 0.28, 0.16),
    2.0,
    0.28,
    0.35,
    30.0,
    0.0,
    {"xyz": [0.04, 0.0, 0.10], "rpy": [0.0, np.pi / 2.0, 0.0]},
    {"kind": "box", "size": [0.04, 0.09, 0.14], "xyz": [0.02, 0.0, 0.07]},
)


def problem(seed: int) -> dict[str, Any]:
    """A problem's tables: even seeds have UR10, odd ones Pandas; posts, shelves or both."""
    rng = np.random.default_rng([14, seed])
    arm = (UR10, PANDA)[seed % 2]
    size = np.array(arm.size)
    side = float(rng.choice([-1.0, 1.0]))
    start = np.array([-side * arm.reach * rng.uniform(0.8, 1.1), rng.uniform(-0.05, 0.05), 0.0])
    goal = np.array([side * arm.reach * rng.uniform(0.6, 1.1), rng.uniform(-0.08, 0.08), 0.0])
    start[2] = arm.height + rng.uniform(-0.05, 0.10)
    goal[2] = arm.height + rng.uniform(-0.05, 0.30)
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
        "payload": {"size": list(arm.size), "mass": arm.mass},
        "contacts": [
            {"xyz": [0.0, s * arm.size[1] / 2.0, 0.0], "friction": 0.8, "patch_radius": 0.04}
            for s in (1.0, -1.0)
        ],
        "task": {
            "start": [*np.round(start, 4).tolist(), 0.0, 0.0, 0.0],
            "goal": [*np.round(goal, 4).tolist(), 0.0, 0.0, round(yaw, 4)],
            "reference_speed": 0.25,
            "reference_force": arm.force,
        },
        "environment": environment,
    }


def _robot(arm: ArmType, side: float) -> dict[str, Any]:
    return {
        "name": "north" if side > 0.0 else "south",
        "urdf": str(example_robot(arm.urdf)),
        "chain": list(arm.chain),
        "drop_links": list(arm.drop),
        "base": {
            "xyz": [0.0, side * arm.apart, arm.pedestal],
            "rpy": [0.0, 0.0, -side * np.pi / 2],
        },
        "pad": arm.pad,
        "tool": [{"name": "pad", **arm.tool}],
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--time", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--folder", type=Path, default=Path())
    options = parser.parse_args()
    solved = 0
    for cell in range(options.first, options.first + options.cells):
        path, begun = write_problem(cell, options.folder), time.monotonic()
        used = resource.getrusage(resource.RUSAGE_SELF).ru_utime
        try:
            settings = ho.ProposeSettings(seconds=options.time)
            rng = np.random.default_rng(options.seed)
            found = ho.propose(path, rng=rng, settings=settings)
            path.with_name(f"cell{cell:02d}-proposed.toml").write_text(found.text(path.parent))
            text, solved = str(found), solved + 1
        except ProposalError as error:
            text = str(error)
        used = resource.getrusage(resource.RUSAGE_SELF).ru_utime - used
        print(f"{cell:2d} {time.monotonic() - begun:5.1f} s, {used:5.1f} s CPU: {text}", flush=True)
    print(f"{solved} of {options.cells}")


if __name__ == "__main__":
    main()
