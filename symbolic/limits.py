"""The limits on the timing of a path: one table, and the layout of their coefficients.

Rows of timings and of the polish, ratios of a carry, messages, margins and the enumeration of the
compiled passes follow from `LIMITS`. With the path parameter u driven as u(t), every limit is a
bound on a function of u'' and u'^2 whose coefficients `symbolic.limit_coefficients` computes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from symbolic.records import Workcell

Scope = Literal["joint", "payload", "robot"]
"""Number of values of a limit: one per joint of both arms, one for the payload, or one per
robot."""

SlackGroup = Literal["motion", "force", "ratio"]
"""Groups of limits between whose kinds the compiled passes distinguish when they tighten limits
between grid points: limits on motion alone, on the convex normal forces, and on ratios of contact
forces, which are not convex."""


@dataclass(frozen=True)
class Limit:
    """One limit on the timing of a path.

    Attributes:
        name: name in messages, records and `hybrid_opt.timing.model.CarryLimits.ratios`.
        symbol: name of the limit in the compiled passes.
        unit: unit of the limited quantity.
        expression: text of the limited ratio; the ratio is at most 1.
        group: 'motion' for limits on motion alone, 'force' for the convex normal forces, 'ratio'
            for ratios of contact forces, which are not convex.
        scope: 'joint', 'robot' or 'payload': one value per joint, per robot, or for the payload.
        block: name of a block in `limit_layout` and `symbolic.smooth.driven.driven_layout`.
        option: field of `hybrid_opt.timing.records.TimingLimits` that switches the limit on; '' if
            it is always on.
        path: limited quantity of `symbolic.path_motion` (q, pose or angular), '' for none. The
            limit bounds its first derivative by u and, for accelerations, its second as well.
        carry: name of the limited quantity in a carry, '' for none.
        bound: field of the robots or of the payload that states the largest value, '' for none.
    """

    name: str
    symbol: str
    unit: str
    expression: str
    group: SlackGroup
    scope: Scope
    block: str
    option: str = ""
    path: str = ""
    carry: str = ""
    bound: str = ""

    @property
    def is_signed(self) -> bool:
        """True if the limited quantity has a sign and its absolute value is limited."""
        return self.block in ("acceleration", "torque")


LIMITS = (
    Limit(
        "joint velocity",
        "JOINT_SPEED",
        "rad/s",
        "|q_u u'| / velocity_max",
        group="motion",
        scope="joint",
        block="speed",
        path="q",
        carry="q_rate",
        bound="velocity_max",
    ),
    Limit(
        "payload velocity",
        "BOX_SPEED",
        "m/s",
        "|p_u u'| / velocity_max",
        group="motion",
        scope="payload",
        block="speed",
        path="pose",
        carry="rate",
        bound="velocity_max",
    ),
    Limit(
        "payload angular velocity",
        "BOX_TURN",
        "rad/s",
        "|omega_u u'| / angular_velocity_max",
        group="motion",
        scope="payload",
        block="speed",
        path="angular",
        carry="angular_velocity",
        bound="angular_velocity_max",
    ),
    Limit(
        "path speed",
        "PATH_SPEED",
        "1",
        "max(|p_u u'| / reference_speed, |omega_u u'| / reference_angular_speed)",
        group="motion",
        scope="payload",
        block="speed",
        option="reference_speed",
    ),
    Limit(
        "joint acceleration",
        "JOINT_ACCELERATION",
        "rad/s^2",
        "|q_u u'' + q_uu u'^2| / acceleration_max",
        group="motion",
        scope="joint",
        block="acceleration",
        path="q",
        carry="q_second",
        bound="acceleration_max",
    ),
    Limit(
        "payload acceleration",
        "BOX_ACCELERATION",
        "m/s^2",
        "|p_u u'' + p_uu u'^2| / acceleration_max",
        group="motion",
        scope="payload",
        block="cone",
        path="pose",
        carry="second_rate",
        bound="acceleration_max",
    ),
    Limit(
        "payload angular acceleration",
        "BOX_TURN_ACCELERATION",
        "rad/s^2",
        "|omega_u u'' + omega_uu u'^2| / angular_acceleration_max",
        group="motion",
        scope="payload",
        block="cone",
        path="angular",
        carry="angular_acceleration",
        bound="angular_acceleration_max",
    ),
    Limit(
        "normal force",
        "NORMAL_FORCE",
        "N",
        "N_i(u'', u'^2) / force",
        group="force",
        scope="robot",
        block="force",
        option="force",
    ),
    Limit(
        "joint torque",
        "JOINT_TORQUE",
        "N m",
        "|tau(u'', u'^2)| / torque_max",
        group="ratio",
        scope="joint",
        block="torque",
        option="torque",
        carry="torque",
        bound="torque_max",
    ),
    Limit(
        "pressure shift",
        "PRESSURE",
        "m",
        "|d_i(u'', u'^2)| / patch radius",
        group="ratio",
        scope="robot",
        block="pressure",
        option="pressure",
        carry="pressure_shift",
        bound="patch_radius",
    ),
)
"""All limits on timings, in the order of the compiled passes: speeds, accelerations, forces."""

LIMIT_NAMES = tuple(limit.name for limit in LIMITS)


def limits_of_block(block: str) -> tuple[Limit, ...]:
    """Return the limits whose coefficients lie in the block named `block`, in the order of the
    coefficients."""
    return tuple(limit for limit in LIMITS if limit.block == block)


def passes_enumeration() -> str:
    """Return C source text with two enumerations, the kinds and the groups of all limits, and an
    array that maps each kind to its group. The compiled forward and backward passes of a timing
    include it."""
    groups = list(dict.fromkeys(limit.group for limit in LIMITS))
    names = ", ".join(limit.symbol for limit in LIMITS)
    own = ", ".join(limit.group.upper() for limit in LIMITS)
    return (
        f"enum {{ {names}, KINDS }};\n"
        f"enum {{ {', '.join(group.upper() for group in groups)}, GROUPS }};\n"
        f"static const int GROUP[KINDS] = {{{own}}};\n"
    )


SPEEDS_OF_BOX = 4
"""Speeds of the box: payload, payload rotation, reference, reference rotation."""


@dataclass(frozen=True)
class BlockLayout:
    """Layout of a vector that consists of named blocks, one after the other.

    Attributes:
        joints: number of joints of both arms together.
        sizes: number of entries of each block by name, in the order of the vector.
    """

    joints: int
    sizes: dict[str, int]

    @property
    def offsets(self) -> dict[str, int]:
        """Index of the first entry of each block, by name."""
        sizes = self.sizes
        ends = np.cumsum([0, *sizes.values()]).tolist()
        return dict(zip(sizes, ends, strict=False))

    def block(self, name: str) -> slice:
        """Return the slice of the vector that holds the block `name`."""
        start = self.offsets[name]
        return slice(start, start + self.sizes[name])

    @property
    def size(self) -> int:
        """Number of entries of the whole vector."""
        return sum(self.sizes.values())


def limit_layout(workcell: Workcell) -> BlockLayout:
    """Return the layout of the coefficients of all timing limits at one sample. All blocks except
    force and moment are divided by the limits, so that 1 is the bound.

    Blocks, in order; joints counts both arms:

    speed (joints + 4): coefficients d of abs(d u') <= 1, for the joints, the payload, its rotation,
    and the two reference speeds, which apply on request only.

    acceleration (2, joints): coefficients alpha, then beta of abs(alpha u'' + beta u'^2) <= 1.

    cone (2, 2, 3): vectors p and q of norm(p u'' + q u'^2) <= 1, for the payload's acceleration,
    then for its angular acceleration.

    force (3, 3): required force by u'', by u'^2 and at rest [N], along the axes of contact 1, the
    normal last.

    moment (2, 3): required moment about the centre of mass by u'' and by u'^2 [N m], along the axes
    of contact 1.

    torque (3, joints): joint torques of the arms without the box, by u'', by u'^2 and at rest.

    wrench (joints, 6): joint torques per unit of contact wrench about the nominal contact point,
    along the axes of contact 1.
    """
    j = sum(robot.velocity_max.shape[0] for robot in workcell.robots)
    sizes = {"speed": j + SPEEDS_OF_BOX, "acceleration": 2 * j, "cone": 12, "force": 9, "moment": 6}
    return BlockLayout(j, sizes | {"torque": 3 * j, "wrench": 6 * j})
