"""A driven box in MuJoCo, to find whether it stays in place when pressed with a multiple of a
force.

The carriage is set to the planned state of the box frame at every step, and accelerated as planned
within the step. So the pads move exactly as planned, as on stiff arms; the box is free, and only
friction holds it. `Outcome`, `Threshold` and `HeldBox` serve simulations of whole cells too.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from types import ModuleType
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation

from hybrid_opt.carry import Carry
from hybrid_opt.cell import Cell
from hybrid_opt.errors import SimulationError
from hybrid_opt.extras.simulation.scene import (
    CARRIAGE_MASS,
    PAD_MASS,
    SimulationSettings,
    compiled,
    rim,
    scene_text,
    tilt_centre,
    tilt_names,
)
from symbolic.array import Array, interpolated
from symbolic.contact.registry import require_squeeze
from symbolic.errors import SettingsError
from symbolic.records import Contact, Workcell
from symbolic.records.poses import box_rotation

BEGINS = 0.05
"""Slip counts as begun at this share of the slip that counts as slipped."""

SAME_TIME = 1e-9
"""Samples that are closer in time than this are both sides of a jump [s]."""

SLIP_INTERVAL = 2e-3
"""Time between two measurements of the slip [s]."""

RIM_POINTS = 8
"""Number of points on the rim of each robot's first patch at which the slip is measured."""


@dataclass(frozen=True)
class Outcome:
    """Outcome of one simulation, with measurements at n times.

    Attributes:
        factor: number by which the pressing force was multiplied.
        holds: True if the box slipped by less than the `slip` of the settings.
        time: (n,) times of the measurements [s], the first when the pads are pressed and the box is
            at rest.
        slip: (n, 2) largest displacement of the box in the plane of each robot's pad since the
            first time [m].
        turn: (n,) rotation of the box between its pads since the first time [rad].
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
        """Return the time at which the box begins to slip [s]: its largest displacement first
        exceeds `BEGINS` times `slip`. Infinite if it never does.

        Args:
            slip: displacement that counts as slip [m].
        """
        beyond = np.flatnonzero(self.slip.max(axis=1) > BEGINS * slip)
        return float(self.time[beyond[0]]) if len(beyond) else float("inf")


AnyOutcome = TypeVar("AnyOutcome", bound=Outcome)


@dataclass(frozen=True)
class Threshold(Generic[AnyOutcome]):
    """The least factor of a force that holds the box, bracketed by two simulations.

    Attributes:
        slips: outcome of the simulation with a factor just below, in which the box slips.
        holds: outcome of the simulation with a factor just above, in which the box holds.
    """

    slips: AnyOutcome
    holds: AnyOutcome

    @property
    def factor(self) -> float:
        """Mean of the factors of both simulations."""
        return (self.slips.factor + self.holds.factor) / 2.0


def bisected(
    simulate: Callable[[float], AnyOutcome], low: float, high: float, steps: int
) -> Threshold[AnyOutcome]:
    """Find by bisection the least factor on the forces at which the box does not slip.

    Args:
        simulate: function that runs a simulation with a factor and returns its outcome.
        low: factor at which the box slips.
        high: factor at which the box does not slip.
        steps: number of bisections.

    Returns:
        The two simulations between whose factors the least factor lies: one in which the box slips,
        and one in which it does not.

    Raises:
        SimulationError: the box does not slip at `low`, or slips at `high`.
    """
    slips, holds = simulate(low), simulate(high)
    if slips.holds or not holds.holds:
        what = f"holds at {low:g}" if slips.holds else f"slips at {high:g}"
        raise SimulationError(f"the box {what} times the force; give other factors")
    for _ in range(steps):
        middle = simulate((slips.factor + holds.factor) / 2.0)
        slips, holds = (slips, middle) if middle.holds else (middle, holds)
    return Threshold(slips, holds)


def mujoco_module() -> ModuleType:
    """Import the simulator.

    Raises:
        SimulationError: MuJoCo is not installed.
    """
    try:
        import mujoco
    except ImportError as error:
        raise SimulationError(
            "MuJoCo is not installed: pip install 'dual-arm-carry[sim]'"
        ) from error
    module: ModuleType = mujoco
    return module


class HeldBox:
    """Measurement of the box's pose between its pads in one simulation, as at the beginning of the
    last step.

    Attributes:
        sites: indices of MuJoCo's sites of both pads.
        box: index of MuJoCo's body of the box.
    """

    def __init__(self, model: Any, data: Any, workcell: Workcell) -> None:
        """Find pads and box in a model of `hybrid_opt.extras.simulation.scene`.

        Args:
            model, data: MuJoCo's model and its state.
            workcell: the cell.
        """
        self.sites = [int(model.site(f"pad_{i + 1}").id) for i in (0, 1)]
        self.box = int(model.body("box").id)
        self._data = data
        rims = np.array([rim(contact, RIM_POINTS) for contact in workcell.contacts])
        self._rims = np.concatenate([rims, np.zeros((2, RIM_POINTS, 1))], axis=2)
        self._settled: tuple[Array, Array] | None = None

    def look(self) -> tuple[Array, float]:
        """Measure how far the box has moved between its pads since the first call.

        Returns:
            - Slip (2,), for each pad the largest displacement of the box in the pad's plane, at the
              rim of its patch [m].
            - Rotation of the box relative to the first pad [rad].
        """
        axes = self._data.site_xmat[self.sites].reshape(2, 3, 3)
        places = self._data.site_xpos[self.sites][:, None]
        position = self._data.xpos[self.box]
        rotation = self._data.xmat[self.box].reshape(3, 3)
        turned = axes[0].T @ rotation
        if self._settled is None:
            world = self._rims @ np.swapaxes(axes, 1, 2) + places
            self._settled = (world - position) @ rotation, turned
        on_box, at_first = self._settled
        moved = (on_box @ rotation.T + position - places) @ axes - self._rims
        slip = np.linalg.norm(moved[..., :2], axis=2).max(axis=1)
        return slip, float(Rotation.from_matrix(at_first.T @ turned).magnitude())


@dataclass(frozen=True)
class CarriageMotion:
    """Motion of the carriage, the moving body that bears all pads of a simulation without arms, at
    n time steps.

    Attributes:
        time: (n,) times, from the negative settling time to the end of the carry [s].
        pose: (n, 7) pose of the box frame: position in the world [m], then unit quaternion with the
            real part first.
        velocity, acceleration: (n, 6) linear along world axes [m/s, m/s^2], then angular along box
            axes [rad/s, rad/s^2].
        rotation: (n, 3, 3) R_world_box.
    """

    time: Array
    pose: Array
    velocity: Array
    acceleration: Array
    rotation: Array

    def acceleration_at(self, point: Array) -> Array:
        """Compute the acceleration (n, 3) along box axes of a point that moves with the box frame
        [m/s^2].

        Args:
            point: (3,) position of the point in the box frame [m].
        """
        spin, spin_rate = self.velocity[:, 3:], self.acceleration[:, 3:]
        linear = np.einsum("nji,nj->ni", self.rotation, self.acceleration[:, :3])
        turned: Array = linear + np.cross(spin_rate, point)
        return turned + np.cross(spin, np.cross(spin, point))

    def apply(self, data: Any, k: int) -> None:
        """Set the carriage, the first body of a simulation, to its state at a time step.

        Args:
            data: MuJoCo's state, which is changed.
            k: index of the time step.
        """
        data.qpos[:7], data.qvel[:6] = self.pose[k], self.velocity[k]
        data.qfrc_applied[:6] = CARRIAGE_MASS * self.acceleration[k]


@dataclass(frozen=True)
class Drive:
    """Motion of the carriage, which bears both pads, and pressing force at n time steps.

    Attributes:
        leader: index of the pad that is fixed to the carriage; the other pad slides along its
            normal.
        motion: motion of the carriage.
        press: (n,) normal force of the sliding pad [N].
        own: (n,) force along the sliding pad's normal that accelerates the pad's own mass [N].
        tilt: (n, 2, 2) planned moments of both pads about the x and y axes of their frames [N m].
    """

    leader: int
    motion: CarriageMotion
    press: Array
    own: Array
    tilt: Array


def planned_moments(cell: Cell, carry: Carry) -> Array:
    """Compute the moment of each robot's planned wrench about the middle of the robot's pads.

    Args:
        cell: the cell.
        carry: the carry at n samples.

    Returns:
        (n + 1, 2, 3) moments of both robots, world frame [N m]: first at rest before the carry,
        then at its samples.
    """
    workcell = carry.workcell
    still = np.zeros_like(carry.rate[:1])
    known = replace(
        carry,
        pose=np.concatenate([carry.pose[:1], carry.pose]),
        rate=np.concatenate([still, carry.rate]),
        second_rate=np.concatenate([still, carry.second_rate]),
    )
    friction = np.array([contact.friction for contact in workcell.contacts])
    load = cell.timing_model.uncertain_load(known, friction, workcell.payload.centre_of_mass)
    rotation = box_rotation(workcell.task.orientation, known.pose)
    moments = []
    for i, contact in enumerate(workcell.contacts):
        wrench = load[f"wrench_{i + 1}"]
        arm = rotation @ contact.T_box_pad[:3, :3] @ tilt_centre(contact)
        moments.append(wrench[:, 3:] - np.cross(arm, wrench[:, :3]))
    return np.stack(moments, axis=1)


def drive_of(
    carry: Carry,
    settings: SimulationSettings,
    press: Array | None = None,
    leader: int = 0,
    moments: Array | None = None,
) -> Drive:
    """Compute the motion of the pads and the pressing force for the simulation of a carry. The box
    is at rest for some time before it.

    Args:
        carry: the carry at n samples.
        settings: settings of the simulation.
        press: (n,) normal force of the sliding pad, that of the arm other than `leader`, at the
            samples [N]; None for the planned normal force of this arm.
        leader: index of the arm whose pad is fixed to the carriage, the body that bears both pads.
        moments: moments from `planned_moments`, with which the pads press unevenly; None for pads
            without moments.

    Raises:
        SettingsError: the carry does not start and end at rest, or `press` has another shape.
    """
    force = carry.normal_force[:, 1 - leader] if press is None else press
    if force.shape != carry.time.shape:
        raise SettingsError(f"forces of shape {force.shape} for {len(carry)} samples", code="shape")
    motion = carriage_motion(carry, settings)
    begin, end = float(carry.time[0]), float(carry.time[-1])
    clipped = np.clip(motion.time, begin, end)
    slider = carry.workcell.contacts[1 - leader]
    R_box_pad = slider.T_box_pad[:3, :3]
    at_pad = motion.acceleration_at(slider.T_box_pad[:3, 3] + R_box_pad @ tilt_centre(slider))
    tilt = np.zeros((len(motion.time), 2, 2))
    for i, contact in enumerate(carry.workcell.contacts if moments is not None else ()):
        assert moments is not None
        moment = interpolated(clipped, carry.time, moments[1:, i])
        moment[motion.time < begin] = moments[0, i]
        axes = motion.rotation @ contact.T_box_pad[:3, :2]
        tilt[:, i] = np.einsum("nji,nj->ni", axes, moment)
    return Drive(
        leader=leader,
        motion=motion,
        press=np.interp(clipped, carry.time, force),
        own=PAD_MASS * at_pad @ R_box_pad[:, 2],
        tilt=tilt,
    )


def carriage_motion(carry: Carry, settings: SimulationSettings) -> CarriageMotion:
    """Compute the motion of the pads for the simulation of a carry. The box is at rest for some
    time before the carry.

    Args:
        carry: the carry.
        settings: settings of the simulation, with the time at rest.

    Raises:
        SettingsError: the carry does not start and end at rest.
    """
    refuse_motion_at_ends(carry)
    begin, end = float(carry.time[0]), float(carry.time[-1])
    steps = int(np.ceil((end - begin + settings.settle) / settings.time_step)) + 1
    time = begin - settings.settle + settings.time_step * np.arange(steps)
    # A step takes the new velocity all along it: poses and accelerations are those amid steps.
    clipped, amid = (np.clip(at, begin, end) for at in (time, time + settings.time_step / 2.0))
    single = np.concatenate([[True], np.diff(carry.time) > SAME_TIME])
    path = CubicHermiteSpline(carry.time[single], carry.pose[single], carry.rate[single])
    rotation = box_rotation(carry.workcell.task.orientation, path(amid))
    turn = Rotation.from_matrix(rotation).as_quat(scalar_first=True)
    omega = interpolated(clipped, carry.time, carry.angular_velocity)
    acceleration, alpha = (
        ((amid > begin) & (amid < end))[:, None] * interpolated(amid, carry.time, values)
        for values in (carry.second_rate[:, :3], carry.angular_acceleration)
    )
    spin, spin_rate = (np.einsum("nji,nj->ni", rotation, values) for values in (omega, alpha))
    return CarriageMotion(
        time=np.asarray(time),
        pose=np.column_stack([path(amid)[:, :3], turn]),
        velocity=np.column_stack([path(clipped, 1)[:, :3], spin]),
        acceleration=np.column_stack([acceleration, spin_rate]),
        rotation=rotation,
    )


def refuse_motion_at_ends(carry: Carry) -> None:
    """Check that a carry starts and ends at rest, as simulations need.

    Args:
        carry: the carry.

    Raises:
        SettingsError: the carry does not start and end at rest.
    """
    if max(np.abs(carry.rate[[0, -1]]).max(), np.abs(carry.angular_velocity[[0, -1]]).max()) > 1e-3:
        raise SettingsError(
            "the carry does not start and end at rest; give one with a timing", code="not-at-rest"
        )


class BoxSimulation:
    """Simulation of the box of one workcell between its pads, without arms.

    Attributes:
        workcell, settings: the cell, and settings of the simulation.
    """

    def __init__(
        self,
        workcell: Workcell,
        settings: SimulationSettings | None = None,
        disturbance: ArrayLike = (0.0, 0.0, 0.0),
    ) -> None:
        """Build the model of the scene. Nothing is simulated yet.

        Args:
            workcell: the cell.
            settings: settings of the simulation; None for the defaults.
            disturbance: (3,) acceleration that the pads have to give the box in addition to the
                acceleration of the motion, world frame [m/s^2].

        Raises:
            SimulationError: MuJoCo is not installed.
            SettingsError: the cell has hands that hold without a squeeze.
        """
        self.workcell = workcell
        self.settings = settings or SimulationSettings()
        self._mujoco = mujoco_module()
        require_squeeze(workcell, "a simulation of pads")
        self._disturbance = disturbance
        self._model = cache(self._compiled)

    def simulate(self, drive: Drive, factor: float = 1.0) -> Outcome:
        """Simulate one carry until its end or until the box slips.

        Args:
            drive: motion of the pads and pressing force.
            factor: number by which the pressing force is multiplied.
        """
        mujoco, model, settings = self._mujoco, self._model(drive.leader), self.settings
        data = mujoco.MjData(model)
        held = HeldBox(model, data, self.workcell)
        box, moves = (int(getattr(model.joint("box"), at)[0]) for at in ("qposadr", "dofadr"))
        press = int(model.joint("press").dofadr[0])
        driven = (0, 1) if settings.pads == "driven" else ()
        tilts = [[int(model.joint(name).dofadr[0]) for name in tilt_names(i)] for i in driven]
        motion = drive.motion
        data.qpos[box : box + 7] = motion.pose[0]
        force = factor * drive.press + drive.own
        every = max(1, round(SLIP_INTERVAL / settings.time_step))
        time, slip, turn = [], [], []
        for k, now in enumerate(motion.time):
            motion.apply(data, k)
            if now < motion.time[0] + settings.settle / 4.0:
                # It stands until the pads press: what hardly holds it does not stop a falling box.
                data.qvel[moves : moves + 6] = 0.0
            data.qfrc_applied[press] = force[k]
            for i in driven:
                data.qfrc_applied[tilts[i]] = drive.tilt[k, i]
            mujoco.mj_step(model, data)
            if k % every or now < motion.time[0] + settings.settle / 2.0:
                continue
            moved, turned = held.look()
            time.append(float(now))
            slip.append(moved)
            turn.append(turned)
            if not moved.max() <= settings.slip:
                break
        holds = bool(slip[-1].max() <= settings.slip)
        return Outcome(factor, holds, np.array(time), np.array(slip), np.array(turn))

    def _compiled(self, leader: int) -> Any:
        text = scene_text(self.workcell, self.settings, leader, self._disturbance)
        return compiled(self._mujoco, text)[0]


def workcell_of_case(workcell: Workcell, case: Array) -> Workcell:
    """Return the workcell with the payload, friction and pads of one case of its uncertainty. The
    disturbance and the arms' errors in a case have no place in a workcell and are left out.

    Args:
        workcell: the cell.
        case: (18,) values in the order of `symbolic.contact.worst_cases.CASE_SIZES`.
    """
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
