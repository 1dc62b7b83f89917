"""Problem files for tests: shipped cells without what is proposed, and machines with two arms."""

from __future__ import annotations

import re
from pathlib import Path

WORKCELLS = Path("studies/workcells").resolve()

_BAXTER_ARM = """
[[robots]]
name = "{side}"
urdf = "package://example-robot-data/robots/baxter_description/urdf/baxter.urdf"
srdf = "package://example-robot-data/robots/baxter_description/srdf/baxter_manipulation.srdf"
chain = ["base", "{side}_hand_link"]
drop_links = ["{side}_gripper_base_link"]
base = {{ xyz = [0.0, 0.0, 0.93] }}
pad = {{ xyz = [0.0, 0.0, 0.08] }}
min_manipulability = 0.002

[[robots.tool]]
name = "pad"
kind = "cylinder"
radius = 0.03
length = 0.08
xyz = [0.0, 0.0, 0.04]
"""

BAXTER = f"""
name = "Baxter"
{_BAXTER_ARM.format(side="left")}{_BAXTER_ARM.format(side="right")}
[payload]
size = [0.2, 0.3, 0.2]
mass = 2.0

[[contacts]]
friction = 0.8
patch_radius = 0.03

[[contacts]]
friction = 0.8
patch_radius = 0.03

[task]
start = [0.6, -0.17, 1.0, 0.0, 0.0, 0.0]
goal = [0.6, 0.17, 1.0, 0.0, 0.0, 0.0]
reference_speed = 0.2
reference_force = 30.0

[[environment]]
name = "wall"
kind = "box"
size = [0.3, 0.02, 0.10]
xyz = [0.65, 0.0, 0.86]
"""

WALL = """
[[environment]]
name = "wall"
kind = "box"
size = [0.04, 0.5, 1.0]
xyz = [0.0, 0.0, 0.5]
"""


def shipped_problem(name: str, folder: Path) -> Path:
    """A cell that ships, with absolute paths; what is proposed anew may stay in it."""
    text = (WORKCELLS / f"{name}.toml").read_text(encoding="utf-8")
    path = folder / f"{name}.toml"
    path.write_text(text.replace("../robots/", f"{WORKCELLS.parent}/robots/"), encoding="utf-8")
    return path


def tiago_problem(folder: Path) -> Path:
    """The TIAGo as a newcomer may give it: no redundant joints, no contact points, no spins."""
    path = shipped_problem("tiago", folder)
    text = path.read_text(encoding="utf-8")
    text = re.sub(r"(redundant_joints|spin) = .*\n", "", text)
    text = re.sub(r"(?<=\[\[contacts\]\]\n)xyz = .*\n", "", text)
    path.write_text(text, encoding="utf-8")
    return path


def turned_problem(folder: Path, rotation: str) -> Path:
    """The transfer cell with a wall higher than the box's place, over which it is turned over."""
    path = shipped_problem("transfer", folder)
    text = path.read_text(encoding="utf-8")
    task = f"""[task]
rotation = "{rotation}"
start = [-0.30, 0.0, 0.90, 0.0, 0.0, 0.0]
goal = [0.30, 0.0, 0.90, 0.0, 3.141592653589793, 0.0]
samples = 60
reference_speed = 0.30
reference_force = 117.68
"""
    path.write_text(text[: text.index("[task]")] + task + WALL, encoding="utf-8")
    return path
