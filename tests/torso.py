"""A machine of our own for tests: a pillar, torso joints, two arms of six joints that hang down."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from symbolic.read.editing import completed, merged

ARM = (
    # axis, lower and upper limit [rad], effort [N m], offset from the joint before [m]
    ("0 1 0", -3.0, 3.0, 60.0, "0 {shoulder} 0.28"),
    ("1 0 0", -0.2, 2.9, 60.0, "0 0 0"),
    ("0 1 0", -2.7, 0.0, 40.0, "0 0 -0.30"),
    ("0 0 1", -3.0, 3.0, 15.0, "0 0 -0.02"),
    ("0 1 0", -1.7, 1.9, 15.0, "0 0 -0.26"),
    ("0 0 1", -2.8, 2.8, 10.0, "0 0 -0.09"),
)
"""The left arm; the right one is its mirror image in y."""

SHAPES = {
    1: ('<cylinder radius="0.05" length="0.18"/>', "0 0 -0.16"),
    3: ('<cylinder radius="0.04" length="0.16"/>', "0 0 -0.12"),
    5: ('<cylinder radius="0.03" length="0.04"/>', "0 0 0"),
}


@dataclass(frozen=True)
class Torso:
    """What is special about one machine.

    Attributes:
        axes: of the torso's joints, from the pillar upwards.
        effort: multiplies every effort of the arms.
        wrist_speed: of each arm's last joint [rad/s].
        more: URDF elements that hang on links of the machine.
    """

    axes: tuple[str, ...] = ("0 0 1",)
    effort: float = 1.0
    wrist_speed: float = 2.5
    more: str = ""

    def urdf(self) -> str:
        """Write the machine; neighbours overlap at the torso's joints, as in most machines."""
        elements = [
            _link("foot", 50.0, '<box size="0.5 0.4 0.1"/>', "0 0 0.05"),
            _link("pillar", 20.0, '<cylinder radius="0.08" length="0.8"/>', "0 0 0.4"),
            _joint("mount", "foot", "pillar", "0 0 0.1", kind="fixed"),
        ]
        parent, at = "pillar", "0 0 0.8"
        for k, axis in enumerate(self.axes):
            name = f"torso_{k}" if k + 1 < len(self.axes) else "chest"
            size = "0.16 0.16 0.14" if name != "chest" else "0.18 0.24 0.36"
            height = 0.05 if name != "chest" else 0.15
            elements.append(_link(name, 8.0, f'<box size="{size}"/>', f"0 0 {height}"))
            limit = (-2.0, 2.0, 150.0, 1.5)
            elements.append(_joint(f"torso_joint_{k}", parent, name, at, axis, limit))
            parent, at = name, "0 0 0.12"
        for side, sign in (("left", 1.0), ("right", -1.0)):
            before = parent
            for k, (axis, low, high, effort, offset) in enumerate(ARM):
                if axis == "1 0 0" and sign < 0.0:
                    low, high = -high, -low
                speed = self.wrist_speed if k + 1 == len(ARM) else 2.5
                name = f"{side}_{k}"
                elements.append(_link(name, 1.5, *SHAPES.get(k, ("", "0 0 0"))))
                limit = (low, high, self.effort * effort, speed)
                place = offset.format(shoulder=0.21 * sign)
                elements.append(_joint(f"{side}_joint_{k}", before, name, place, axis, limit))
                before = name
        body = "\n".join([*elements, self.more])
        return f'<?xml version="1.0"?>\n<robot name="torso">\n{body}\n</robot>\n'

    def problem(self, folder: Path, **changes: Any) -> Path:
        """Write a problem file that lifts a light box before the chest.

        Args:
            changes: of the file's tables, see `symbolic.read.editing.merged`.
        """
        (folder / "torso.urdf").write_text(self.urdf(), encoding="utf-8")
        raised = 0.12 * (len(self.axes) - 1)
        finger = {"name": "finger", "kind": "box", "size": [0.04, 0.03, 0.12]}
        robots = [
            {
                "name": side,
                "urdf": "torso.urdf",
                "chain": ["foot", f"{side}_5"],
                "base": {"xyz": [0.0, 0.0, 0.0]},
                "pad": {"xyz": [0.0, -0.015 * sign, -0.1], "rpy": [1.5707963 * sign, 0.0, 0.0]},
                "tool": [{**finger, "xyz": [0.0, 0.0, -0.06]}],
            }
            for side, sign in (("left", 1.0), ("right", -1.0))
        ]
        data = {
            "name": "a torso with two arms",
            "robots": robots,
            "payload": {"size": [0.25, 0.34, 0.12], "mass": 0.8},
            "contacts": [{"friction": 0.8, "patch_radius": 0.02} for _ in robots],
            "task": {
                "start": [0.40, 0.0, 0.80 + raised, 0.0, 0.0, 0.0],
                "goal": [0.40, 0.0, 0.95 + raised, 0.0, 0.0, 0.0],
                "reference_speed": 0.2,
                "reference_force": 30.0,
            },
            "handling": {"lift_height": 0.0, "set_down_height": 0.0},
        }
        path = folder / "torso.toml"
        path.write_text(completed("", merged(data, changes), {}), encoding="utf-8")
        return path


def _link(name: str, mass: float, shape: str = "", at: str = "0 0 0") -> str:
    inertia = 'ixx="0.02" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.02"'
    collision = (
        f'<collision><origin xyz="{at}"/><geometry>{shape}</geometry></collision>' if shape else ""
    )
    return (
        f'<link name="{name}"><inertial><origin xyz="{at}"/><mass value="{mass}"/>'
        f"<inertia {inertia}/></inertial>{collision}</link>"
    )


def _joint(
    name: str,
    parent: str,
    child: str,
    at: str,
    axis: str = "",
    limit: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0),
    kind: str = "revolute",
) -> str:
    low, high, effort, speed = limit
    moving = (
        f'<axis xyz="{axis}"/><limit lower="{low}" upper="{high}" effort="{effort}" '
        f'velocity="{speed}"/>'
    )
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{at}"/>{"" if kind == "fixed" else moving}</joint>'
    )
