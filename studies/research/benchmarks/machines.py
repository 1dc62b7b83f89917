"""Machines with two arms that others ship without a carry: a box over a post, where the arms stand.

NVlabs/curobo at commit a35a708 has two UR10e on one base, 1 m apart (`dual_ur10e.urdf`); MoveIt's
moveit_resources at commit ef5836d two Pandas, 3 m apart, which reach one another's ends of a beam
only. Their makers plan for each arm by itself, so there is nothing published to compare with.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from studies.research.benchmarks.measuring import (
    Benchmark,
    BenchmarkSource,
    BenchmarkTask,
    carry_problem,
)
from symbolic.errors import OutsideError

UR10E = Path("curobo/curobo/content/assets/robot/ur_description/dual_ur10e.urdf")
PANDAS = Path("moveit_resources/dual_arm_panda_moveit_config/config/panda.urdf.xacro")

MACHINES_PAD = 0.12
"""Distance from a flange to its pad [m]."""

TOP = 0.1
"""Thickness of the table top [m]."""

MACHINES_TABLE = {
    "name": "table",
    "kind": "box",
    "size": [0.8, 1.6, TOP],
    "xyz": [0.75, 0.0, TOP / 2.0],
}
GROUND_BODY = {"name": "ground", "kind": "box", "size": [4.0, 5.0, 0.1], "xyz": [0.0, 0.0, -0.06]}

POSTS = (0.30, 0.45, 0.60)
"""Heights above the table [m]."""

MACHINES_NOTE = "Nothing was published: the makers plan for each arm by itself."


def benchmark(folder: Path) -> Benchmark:
    """Return the benchmark of the machines whose files are in the subfolders of `folder`."""
    for file in (UR10E, PANDAS):
        if not (folder / file).is_file():
            raise OutsideError(f"{file} is not there")
    tasks = [_two_ur10e(folder / UR10E, height) for height in POSTS]
    tasks.append(_two_pandas(folder / PANDAS))
    return Benchmark("machines", "Two arms on one base and a post", tuple(tasks), MACHINES_NOTE)


def _two_ur10e(urdf: Path, post: float) -> BenchmarkTask:
    arm = {"urdf": str(urdf.resolve()), "base": {"xyz": [0.0, 0.0, 0.0]}, **_pad(0.04)}
    robots = [
        {"name": "left", "chain": ["world_base_link", "tool0"], **arm},
        {"name": "right", "chain": ["world_base_link", "tool1"], **arm},
    ]
    scene = [MACHINES_TABLE, _post([0.08, 0.08, post], [0.75, 0.0, TOP + post / 2.0])]
    problem = carry_problem(
        f"Two UR10e, a post of {post:g} m",
        robots,
        {"size": [0.2, 0.3, 0.2], "mass": 4.0},
        [{"patch_radius": 0.04}] * 2,
        ([0.5, 0.0, 0.25, 0.0, 0.0, 0.0], [1.0, 0.0, 0.25, 0.0, 0.0, 0.0]),
        scene,
        reference_speed=0.25,
        reference_force=98.1,
    )
    return BenchmarkTask(f"UR10e over {post:g} m", problem)


def _two_pandas(xacro: Path) -> BenchmarkTask:
    robots = [
        {
            "name": name,
            "urdf": str(xacro.resolve()),
            "package_dirs": [str(xacro.resolve().parents[2])],
            "chain": ["world", f"{name}_panda_link8"],
            "drop_links": [f"{name}_panda_hand"],
            "base": {"xyz": [0.0, 0.0, 0.0]},
            **_pad(0.03),
        }
        for name in ("left", "right")
    ]
    problem = carry_problem(
        "Two Pandas, a beam over a post",
        robots,
        {"size": [0.1, 2.0, 0.1], "mass": 2.0},
        [{"patch_radius": 0.03}] * 2,
        ([0.3, 0.0, 0.4, 0.0, 0.0, 0.0], [0.6, 0.0, 0.4, 0.0, 0.0, 0.0]),
        [GROUND_BODY, _post([0.1, 0.1, 0.5], [0.45, 0.0, 0.25])],
        reference_speed=0.25,
        reference_force=29.43,
    )
    return BenchmarkTask("Pandas with a beam", problem)


def _pad(radius: float) -> dict[str, Any]:
    """Return keys of a robot in a workcell file: a round pad on a rod in front of the flange.

    Args:
        radius: radius of the rod and of the pad [m].
    """
    rod = {
        "kind": "cylinder",
        "radius": radius,
        "length": MACHINES_PAD,
        "xyz": [0.0, 0.0, MACHINES_PAD / 2.0],
    }
    return {"pad": {"xyz": [0.0, 0.0, MACHINES_PAD]}, "tool": [{"name": "pad", **rod}]}


def _post(size: list[float], xyz: list[float]) -> dict[str, Any]:
    return {"name": "post", "kind": "box", "size": size, "xyz": xyz}


MACHINES_SOURCE = BenchmarkSource(
    """\
git clone https://github.com/NVlabs/curobo FOLDER/curobo
git -C FOLDER/curobo checkout a35a708
git clone https://github.com/moveit/moveit_resources FOLDER/moveit_resources
git -C FOLDER/moveit_resources checkout ef5836d""",
    Path(),
    benchmark,
)
