"""A driven box in MuJoCo: pressed with a multiple of a force, does it stay in place?

The carriage is set to the planned state of the box frame at every step and accelerated as planned
within it, so that the pads move exactly as planned; the box, free, is held by friction alone.
`Outcome` and `Threshold` are those of whole cells, too.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation

from hybrid_opt.carry import Carry
from hybrid_opt.cell import Cell
from hybrid_opt.errors import WitnessError
from hybrid_opt.witness.scene import (
    CARRIAGE_MASS,
    PAD_MASS,
    SimulationSettings,
    quaternion,
    rim,
    scene_text,
    tilt_centre,
    tilt_names,
)
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.records import Contact, Workcell
from symbolic.records.poses import box_rotation

BEGINS = 0.1
"""Share of the slip that counts as one at which it is said to begin."""

SAME_TIME = 1e-9
"""Samples closer than this stand for both sides of one instant [s]."""

LOOKED_AT = 1e-3
"""Time between two looks at the slip [s]."""

RIM_POINTS = 8
"""Places on the rim of each robot's first patch where the slip is measured."""


@dataclass(frozen=True)
class Outcome:
    """Outcome of one simulation, at n moments.

    Attributes:
        factor: multiple of the pressing force.
        holds: whether the box slipped by less than the settings' slip.
        time: (n,) when it was looked at, from the settled state on [s].
        slip: (n, 2) largest displacement in the plane of each pad since then [m].
        turn: (n,) angle by which the box turned between its pads since then [rad].
    """

    factor: float
    holds: bool
    time: Array
    slip: Array
    turn: Array

    @property
    def pad(self) -> int:
        """Index of the pad with the larger slip at the end."""
        return int(self.slip[-1].argmax())

    def begins(self, slip: float) -> float:
        """Time at which the slip first exceeds a tenth of `slip` [s]; infinite where never."""
        beyond = np.flatnonzero(self.slip.max(axis=1) > BEGINS * slip)
        return float(self.time[beyond[0]]) if len(beyond) else float("inf")


Shown = TypeVar("Shown", bound=Outcome)


@dataclass(frozen=True)
class Threshold(Generic[Shown]):
    """The least multiple of a force that holds.

    Attributes:
        slips, holds: simulations right below and above it.
    """

    slips: Shown
    holds: Shown

    @property
    def factor(self) -> float:
        """Middle of both multiples."""
        return (self.slips.factor + self.holds.factor) / 2.0


def bisected(
    simulate: Callable[[float], Shown], low: float, high: float, steps: int
) -> Threshold[Shown]:
    """The least factor with which a simulation holds, by bisection.

    Args:
        simulate: a factor to what it shows.
        low, high: factors between which it is looked for.
        steps: bisections.

    Raises:
        WitnessError: the box holds at the lower or slips at the higher factor.
    """
    slips, holds = simulate(low), simulate(high)
    if slips.holds or not holds.holds:
        what = f"holds at {low:g}" if slips.holds else f"slips at {high:g}"
        raise WitnessError(f"the box {what} times the force; give other factors")
    for _ in range(steps):
        middle = simulate((slips.factor + holds.factor) / 2.0)
        slips, holds = (slips, middle) if middle.holds else (middle, holds)
    return Threshold(slips, holds)


def mujoco_module() -> ModuleType:
    """The simulator.

    Raises:
        WitnessError: it is not installed.
    """
    try:
        import mujoco
    except ImportError as error:
        raise WitnessError(
            "MuJoCo is not installed; install the extra: pip install -e '.[sim]'"
        ) from error
    module: ModuleType = mujoco
    return module


@dataclass(frozen=True)
class Drive:
    """The carriage's motion and the pressing force at n time steps; world frame.

    Attributes:
        leader: index of the pad that keeps its place on the carriage.
        time: (n,) from minus the time to settle to the end of the carry [s].
        position, velocity, acceleration: (n, 3) of the box frame [m, s].
        rotation: (n, 3, 3) R_world_box.
        quaternion: (n, 4) the same, real part first.
        spin, spin_rate: (n, 3) angular velocity and acceleration in the box frame [rad, s].
        press: (n,) normal force of the other pad [N].
        tilt: (n, 2, 2) planned moments of both pads about the x and y axes of their frames [N m].
        own: (n,) force that the sliding pad's own mass takes along its normal [N].
    """

    leader: int
    time: Array
    position: Array
    velocity: Array
    acceleration: Array
    rotation: Array
    quaternion: Array
    spin: Array
    spin_rate: Array
    press: Array
    tilt: Array
    own: Array


@dataclass(frozen=True, eq=False)
class PlannedMoments:
    """Moments that each robot's pads are to exert on the box about their middle, world frame.

    Attributes:
        along: (n, 2, 3) at the carry's samples [N m].
        at_rest: (2, 3) at rest before it [N m].
    """

    along: Array
    at_rest: Array


def planned_moments(cell: Cell, carry: Carry) -> PlannedMoments:
    """The moments of a carry's planned wrenches, for its own friction and centre of mass."""
    workcell = carry.workcell
    friction = np.array([contact.friction for contact in workcell.contacts])
    still = np.zeros_like(carry.pose[:1])
    resting = replace(carry, pose=carry.pose[:1], rate=still, second_rate=still)
    along, at_rest = (
        np.stack([_about_middle(each, load, i) for i in (0, 1)], axis=1)
        for each, load in (
            (c, cell.timing_model.uncertain_load(c, friction, workcell.payload.centre_of_mass))
            for c in (carry, resting)
        )
    )
    return PlannedMoments(along, at_rest[0])


def _about_middle(carry: Carry, load: Mapping[str, Array], robot: int) -> Array:
    """(n, 3) moments of one robot's planned wrenches about the middle of its pads."""
    workcell, wrench = carry.workcell, load[f"wrench_{robot + 1}"]
    contact = workcell.contacts[robot]
    in_box = contact.T_box_pad[:3, :3] @ tilt_centre(contact)
    arm = box_rotation(workcell.task.orientation, carry.pose) @ in_box
    return np.asarray(wrench[:, 3:] - np.cross(arm, wrench[:, :3]))


def drive_of(
    carry: Carry,
    settings: SimulationSettings,
    press: Array | None = None,
    leader: int = 0,
    moments: PlannedMoments | None = None,
) -> Drive:
    """A carry from rest to rest, with the box at rest before it.

    Args:
        press: (n,) force to press with at the carry's samples; the planned normal force of the
            arm that does not lead by default [N].
        leader: index of the arm that keeps its place.
        moments: what drives pads that tilt; none by default.

    Raises:
        SettingsError: the carry does not start and end at rest, or the force does not fit it.
    """
    if max(np.abs(carry.rate[[0, -1]]).max(), np.abs(carry.angular_velocity[[0, -1]]).max()) > 1e-3:
        raise SettingsError("the carry does not start and end at rest; give one with a timing")
    force = carry.normal_force[:, 1 - leader] if press is None else press
    if force.shape != carry.time.shape:
        raise SettingsError(f"forces of shape {force.shape} for {len(carry)} samples")
    begin, end = float(carry.time[0]), float(carry.time[-1])
    steps = int(np.ceil((end - begin + settings.settle) / settings.time_step)) + 1
    time = begin - settings.settle + settings.time_step * np.arange(steps)
    clipped = np.clip(time, begin, end)
    moving = ((time > begin) & (time < end))[:, None]
    pose, rate = _pose(carry, clipped)
    rotation = box_rotation(carry.workcell.task.orientation, pose)
    acceleration, omega, alpha = (
        moving * _interpolated(clipped, carry.time, values)
        for values in (carry.second_rate[:, :3], carry.angular_velocity, carry.angular_acceleration)
    )
    T_box_pad = carry.workcell.contacts[1 - leader].T_box_pad
    arm, normal = rotation @ T_box_pad[:3, 3], rotation @ T_box_pad[:3, 2]
    at_pad = acceleration + np.cross(alpha, arm) + np.cross(omega, np.cross(omega, arm))
    return Drive(
        leader=leader,
        time=np.asarray(time),
        position=pose[:, :3],
        velocity=moving * rate[:, :3],
        acceleration=acceleration,
        rotation=rotation,
        quaternion=quaternion(rotation),
        spin=np.einsum("nji,nj->ni", rotation, omega),
        spin_rate=np.einsum("nji,nj->ni", rotation, alpha),
        press=np.interp(clipped, carry.time, force),
        tilt=_tilt(carry, np.asarray(time), rotation, moments),
        own=PAD_MASS * np.einsum("ni,ni->n", at_pad, normal),
    )


def _tilt(carry: Carry, time: Array, rotation: Array, moments: PlannedMoments | None) -> Array:
    """(steps, 2, 2) moments about the axes in the planes of the pads."""
    tilt = np.zeros((len(time), 2, 2))
    if moments is None:
        return tilt
    for i, contact in enumerate(carry.workcell.contacts):
        moment = _interpolated(time, carry.time, moments.along[:, i])
        moment[time < carry.time[0]] = moments.at_rest[i]
        axes = rotation @ contact.T_box_pad[:3, :2]
        tilt[:, i] = np.einsum("nji,nj->ni", axes, moment)
    return tilt


def _pose(carry: Carry, time: Array) -> tuple[Array, Array]:
    """Poses and rates (n, 6) at times within the carry, which fit one another."""
    single = np.concatenate([[True], np.diff(carry.time) > SAME_TIME])
    spline = CubicHermiteSpline(carry.time[single], carry.pose[single], carry.rate[single])
    return spline(time), spline(time, 1)


def _interpolated(at: Array, time: Array, values: Array) -> Array:
    return np.column_stack([np.interp(at, time, column) for column in values.T])


class Witness:
    """The box of one workcell between its pads.

    Attributes:
        workcell, settings: what is simulated, and how.
    """

    def __init__(
        self,
        workcell: Workcell,
        settings: SimulationSettings | None = None,
        disturbance: ArrayLike = (0.0, 0.0, 0.0),
    ) -> None:
        """Describe the scene; nothing is simulated yet.

        Args:
            disturbance: (3,) acceleration beside the motion's, world frame [m/s^2].

        Raises:
            WitnessError: MuJoCo is not installed.
        """
        self.workcell = workcell
        self.settings = settings or SimulationSettings()
        self._mujoco = mujoco_module()
        self._disturbance = disturbance
        self._models: dict[int, Any] = {}
        pads = [(contact.T_box_pad, rim(contact, RIM_POINTS)) for contact in workcell.contacts]
        self._normals = np.array([T[:3, 2] for T, _ in pads])[:, None]
        self._rims = np.array([T[:3, 3] + around @ T[:3, :2].T for T, around in pads])

    def simulate(self, drive: Drive, factor: float = 1.0) -> Outcome:
        """One carry with the pressing force times a factor, up to its end or to a slip."""
        mujoco, model, settings = self._mujoco, self._model(drive.leader), self.settings
        data = mujoco.MjData(model)
        box = int(model.joint("box").qposadr[0])
        press = int(model.joint("press").dofadr[0])
        pads = ("pad_1", "pad_2") if settings.tilt_stiffness is not None else ()
        names = [tilt_names(pad) for pad in pads]
        joints = [[int(model.joint(name).dofadr[0]) for name in both] for both in names]
        tilts = np.array(joints, int).reshape(-1, 2)
        data.qpos[:3], data.qpos[3:7] = drive.position[0], drive.quaternion[0]
        data.qpos[box : box + 3], data.qpos[box + 3 : box + 7] = data.qpos[:3], data.qpos[3:7]
        force = factor * drive.press + drive.own
        every = max(1, round(LOOKED_AT / settings.time_step))
        settled: tuple[Array, Array] | None = None
        time, slip, turn = [], [], []
        for k in range(len(drive.time) - 1):
            data.qpos[:3], data.qpos[3:7] = drive.position[k], drive.quaternion[k]
            data.qvel[:3], data.qvel[3:6] = drive.velocity[k], drive.spin[k]
            data.qfrc_applied[:3] = CARRIAGE_MASS * drive.acceleration[k]
            data.qfrc_applied[3:6] = CARRIAGE_MASS * drive.spin_rate[k]
            data.qfrc_applied[press] = force[k]
            data.qfrc_applied[tilts] = drive.tilt[k, : len(tilts)]
            mujoco.mj_step(model, data)
            if k % every or drive.time[k] < drive.time[0] + settings.settle / 2.0:
                continue
            moved, turned = self._displaced(drive, k + 1, data.qpos[box : box + 7])
            settled = settled or (moved, turned)
            time.append(float(drive.time[k + 1]))
            slip.append(np.linalg.norm(moved - settled[0], axis=2).max(axis=1))
            turn.append(float(Rotation.from_matrix(settled[1].T @ turned).magnitude()))
            if not slip[-1].max() <= settings.slip:
                return Outcome(factor, False, np.array(time), np.array(slip), np.array(turn))
        return Outcome(factor, True, np.array(time), np.array(slip), np.array(turn))

    def threshold(self, drive: Drive, low: float, high: float, steps: int) -> Threshold[Outcome]:
        """The least factor that holds, by bisection.

        Args:
            low, high: factors between which it is looked for.
            steps: bisections.

        Raises:
            WitnessError: the box holds at the lower or slips at the higher factor.
        """
        return bisected(lambda factor: self.simulate(drive, factor), low, high, steps)

    def _model(self, leader: int) -> Any:
        if leader not in self._models:
            text = scene_text(self.workcell, self.settings, leader, self._disturbance)
            self._models[leader] = self._mujoco.MjModel.from_xml_string(text)
        return self._models[leader]

    def _displaced(self, drive: Drive, k: int, pose: Array) -> tuple[Array, Array]:
        """Displacements (2, RIM_POINTS, 3) in the planes of the pads, and rotation (3, 3), of the
        box on the carriage."""
        R_world_box = Rotation.from_quat(pose[[4, 5, 6, 3]]).as_matrix()
        turned = drive.rotation[k].T @ R_world_box
        offset = drive.rotation[k].T @ (pose[:3] - drive.position[k])
        moved = self._rims @ turned.T + offset - self._rims
        along = (moved * self._normals).sum(axis=2, keepdims=True)
        return moved - along * self._normals, turned


def witness_of_case(
    workcell: Workcell, case: Array, settings: SimulationSettings | None = None
) -> Witness:
    """A witness whose box, friction and pads are those of a case.

    Args:
        case: (15,), see `symbolic.contact.worst_cases.CASE_SIZES`.

    Raises:
        WitnessError: MuJoCo is not installed.
    """
    return Witness(workcell_of_case(workcell, case), settings, case[8:11])


def workcell_of_case(workcell: Workcell, case: Array) -> Workcell:
    """The workcell as it is in a case (15,), but for the disturbance."""
    payload = workcell.payload
    mass, centre = float(case[4]), case[5:8]
    # The inertia is known about the nominal centre of mass: Steiner's theorem takes it to the true.
    d = centre - payload.centre_of_mass
    facing, planes = workcell.has_facing_pads, [c.T_box_pad[:3, :2] for c in workcell.contacts]
    planes[1] = planes[0] if facing else planes[1]
    inertia = mass / payload.mass * payload.inertia - mass * (d @ d * np.eye(3) - np.outer(d, d))
    first, second = (
        _displaced(contact, float(case[i]), float(case[2 + i]), plane @ case[11 + 2 * i :][:2])
        for i, (contact, plane) in enumerate(zip(workcell.contacts, planes, strict=True))
    )
    return replace(
        workcell,
        payload=replace(payload, mass=mass, centre_of_mass=centre, inertia=inertia),
        contacts=(first, second),
    )


def _displaced(contact: Contact, friction: float, radius: float, by: Array) -> Contact:
    T_box_pad = contact.T_box_pad.copy()
    T_box_pad[:3, 3] += by
    further = tuple(_displaced(pad, friction, pad.patch_radius, by) for pad in contact.further)
    return replace(
        contact, T_box_pad=T_box_pad, friction=friction, patch_radius=radius, further=further
    )
