"""Motions and forces of the phases of a job: straight lines, rest, and the timed carry; and how far
each phase uses its limits.

Every phase except the carry follows a smooth profile h(s) from 0 to 1, with s the time from the
beginning of the phase over its duration:

    h = 35 s^4 - 84 s^5 + 70 s^6 - 20 s^7,

the polynomial of least degree whose first three derivatives vanish at both ends. A phase begins and
ends with zero speed, acceleration and jerk, so torques and forces have no corner.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from codegen.function import NumericFunction
from hybrid_opt.carry import BoxMotion, Carry, joints_of
from hybrid_opt.errors import JobError
from hybrid_opt.job.records import Force, PhaseMotion
from hybrid_opt.robust.squeeze import Squeeze, SqueezeSettings, extra_normal_force
from hybrid_opt.timing.model import TimingModel
from hybrid_opt.timing.records import JerkLimits
from symbolic.array import Array, interpolated
from symbolic.contact.registry import command_model, contact_model
from symbolic.records import Handling, Workcell
from symbolic.records.poses import box_rotation
from symbolic.robot.arm import REACH_TOLERANCE

PHASE_SAMPLES = 401
"""Number of samples of a phase."""

LINE_STEP = 0.005
"""Distance along a line from one Newton solution to the next [m]."""

TICK = 0.008
"""Phases last a whole number of ticks [s], so that controllers of 125, 250, 500 and 1000 Hz meet
their ends."""

LIFTING_ACCELERATION = 0.5
"""Largest acceleration of the box when it is lifted and set down [m/s^2]: a twentieth of gravity,
so that these short motions need no more force than the carry."""

PEAK_RATE = 35.0 / 16.0
"""Largest derivative of h over s in [0, 1]."""

_H = np.polynomial.Polynomial([0.0, 0.0, 0.0, 0.0, 35.0, -84.0, 70.0, -20.0])

_MOVING = ("rate", "second_rate", "q_rate", "q_second")


@dataclass(frozen=True)
class RestToRestProfile:
    """Rest-to-rest profile h(t) from 0 to 1, at n evenly spaced times.

    Attributes:
        time: (n,) times from 0 to the duration [s].
        value: (n,) profile h.
        rate, second, third: (n,) first, second and third time derivative of h.
    """

    time: Array
    value: Array
    rate: Array
    second: Array
    third: Array


def rest_to_rest_profile(duration: float, samples: int) -> RestToRestProfile:
    """Compute the rest-to-rest profile from 0 to 1.

    Args:
        duration: time from 0 to 1 [s].
        samples: number of evenly spaced samples.
    """
    share = np.linspace(0.0, 1.0, samples)
    # Rounding must not leave [0, 1]; the last values of a polynomial of degree 7 would.
    value = np.clip(_H(share), 0.0, 1.0)
    derivatives = [_H.deriv(k)(share) / duration**k for k in (1, 2, 3)]
    for derivative in derivatives:
        derivative[[0, -1]] = 0.0
    return RestToRestProfile(duration * share, value, *derivatives)


def at_even_steps(duration: float, step: float) -> float:
    """Round a duration [s] up to a whole multiple of a time step [s]."""
    return float(np.ceil(duration / step - 1e-9) * step)


@dataclass(frozen=True)
class Straight:
    """Straight translation of the box, of both pads, or of the box and the pads together.

    The pose of a pad is stated by the pose that the box would have if the pad touched it at the
    contact point.

    Attributes:
        name: name of the phase.
        box: (2, 6) box poses at beginning and end, world frame [m, rad].
        held: (2, 2, 6) poses of the pads as box poses [m, rad], by arm, then beginning and end;
            they differ from `box` while the pad is away from the box.
        speed: largest speed [m/s].
    """

    name: str
    box: Array
    held: Array
    speed: float

    @property
    def length(self) -> float:
        """Largest distance that the box or a pad travels [m]."""
        ways = np.concatenate([self.box[None], self.held])
        return float(np.linalg.norm((ways[:, 1] - ways[:, 0])[:, :3], axis=1).max())

    def at(self, share: Array) -> tuple[Array, Array, Array]:
        """Compute the poses of box and pads at points of the line.

        The pose of a pad is stated as the pose that the box would have if the pad touched it at the
        contact point.

        Args:
            share: (n,) points, from 0 at the beginning to 1 at the end of the line.

        Returns:
            Poses (n, 6) of the box, of the pad of arm 1, and of the pad of arm 2 [m, rad].
        """
        ways = np.concatenate([self.box[None], self.held])
        poses = ways[:, None, 0] + share[:, None] * (ways[:, 1] - ways[:, 0])[:, None]
        return poses[0], poses[1], poses[2]


def straight(
    workcell: Workcell, name: str, box: Array, away: tuple[float, float], speed: float
) -> Straight:
    """Build a straight motion of box and pads between two box poses of the same orientation. Pads
    approach or leave the box along their directions of approach.

    Args:
        workcell: the workcell.
        name: name of the phase.
        box: (2, 6) box poses at beginning and end [m, rad].
        away: distance of the pads from the box at beginning and at end [m].
        speed: largest speed [m/s].
    """
    held, contact = np.array([box, box]), contact_model(workcell)
    for arm in (0, 1):
        for end, distance in enumerate(away):
            rotation = box_rotation(workcell.task.orientation, box[end])
            held[arm, end, :3] -= distance * (rotation @ contact.approach(arm))
    return Straight(name, box, held, speed)


def lines_around(
    workcell: Workcell, handling: Handling, stands: tuple[Array, Array], pose: Array
) -> tuple[list[Straight], list[Straight]]:
    """Build the straight motions before and after a carry: approach and lift, set down and retreat.

    Args:
        workcell: the workcell.
        handling: heights, speeds and stand-off of the job.
        stands: poses (6,) of the box on its supports before the carry and after it [m, rad].
        pose: (2, 6) box poses at the beginning and end of the carry [m, rad].

    Returns:
        Motions before the carry and motions after it; in each list the one next to the carry is
        first.
    """
    away, speed = handling.stand_off, handling.pressing_speed
    stand, down = (np.tile(box, (2, 1)) for box in stands)
    before = [straight(workcell, "approach", stand, (away, 0.0), speed)]
    after = [straight(workcell, "retreat", down, (0.0, away), speed)]
    held, speed = (0.0, 0.0), handling.lifting_speed
    if not np.array_equal(stands[0], pose[0]):
        box = np.array([stands[0], pose[0]])
        before.insert(0, straight(workcell, "lift", box, held, speed))
    if not np.array_equal(stands[1], pose[1]):
        box = np.array([pose[1], stands[1]])
        after.insert(0, straight(workcell, "set_down", box, held, speed))
    return before, after


def follow_line(
    workcell: Workcell, posture: NumericFunction, line: Straight, known: Array, at_end: bool
) -> Array:
    """Compute the joint positions (PHASE_SAMPLES, joints) of both arms along a line [rad], by
    Newton's method from known positions at one end.

    The samples are evenly spaced in the time of the rest-to-rest profile. Newton's method first
    solves points every `LINE_STEP`, one after the other. Interpolated, these solutions are the
    initial guesses of all samples. Redundant joints keep their known positions.

    Args:
        workcell: the workcell.
        posture: compiled `symbolic.robot.arm.posture_function`.
        line: the line.
        known: (joints,) joint positions at one end of the line [rad].
        at_end: True if `known` belongs to the end of the line, False for its beginning.

    Raises:
        JobError: an arm does not reach a point of the line within its joint range.
    """

    def share(way: Array) -> Array:
        """Convert points `way` (n,) in [0, 1], counted from that end of the line at which the
        joints are known, to points (n,) counted from the beginning of the line.
        """
        return 1.0 - way if at_end else way

    ways, passed = np.linspace(0.0, 1.0, int(np.ceil(line.length / LINE_STEP)) + 1), [known]
    for way in ways:
        passed.append(
            solve_joints_at(workcell, posture, line, share(way[None]), passed[-1][None])[0]
        )
        if not np.isfinite(passed[-1]).all():
            break
    reached = np.array([q for q in passed[1:] if np.isfinite(q).all()] or [known])
    samples = rest_to_rest_profile(1.0, PHASE_SAMPLES).value
    guess = interpolated(samples, ways[: len(reached)], reached)
    q = solve_joints_at(workcell, posture, line, share(samples), guess)
    lower, upper = map(workcell.stack_joint_limits, ("position_lower", "position_upper"))
    outside = ((q < lower) | (q > upper)).any(axis=1)
    lost = ~np.isfinite(q).all(axis=1)
    for wrong, what in ((lost, "does not reach"), (outside, "leaves its joints' range")):
        if wrong.any():
            place = 1e3 * float(share(samples[wrong][0])) * line.length
            raise JobError(
                f"{line.name.replace('_', ' ')}: an arm {what} {place:.0f} mm from its beginning; "
                "change stand_off, lift_height or set_down_height under [handling]"
            )
    return q[:: -1 if at_end else 1]


def solve_joints_at(
    workcell: Workcell, posture: NumericFunction, line: Straight, share: Array, guess: Array
) -> Array:
    """Compute the joint positions (n, joints) of both arms [rad] at points of a line; NaN where an
    arm does not reach its pad pose.

    Args:
        workcell: the workcell.
        posture: compiled `symbolic.robot.arm.posture_function`.
        line: the line.
        share: (n,) points, from 0 at the beginning to 1 at the end of the line.
        guess: (n, joints) initial guesses of the joint positions [rad].
    """
    guesses = [np.ascontiguousarray(own) for own in joints_of(workcell, guess)]
    found = []
    for arm, poses in enumerate(line.at(share)[1:], start=1):
        solved = posture.batch(poses, *guesses)
        lost = np.ravel(solved[f"residual_{arm}"]) > REACH_TOLERANCE
        found.append(np.where(lost[:, None], np.nan, solved[f"q_{arm}"]))
    return np.concatenate(found, axis=1)


def time_line(model: TimingModel, line: Straight, q: Array) -> PhaseMotion:
    """Compute the motion along a line from rest to rest, as fast as the line's speed and the limits
    of payload and joints allow.

    Args:
        model: timing model of the workcell.
        line: the line.
        q: (PHASE_SAMPLES, joints) joint positions from `follow_line` [rad].
    """
    unit = rest_to_rest_profile(1.0, PHASE_SAMPLES)
    box, *targets = line.at(unit.value)
    own = joints_of(model.workcell, q)
    arms = []
    for arm, poses in enumerate(targets):
        first = np.tile(line.held[arm, 1] - line.held[arm, 0], (PHASE_SAMPLES, 1))
        arms.append(model.arm_motion(arm, own[arm], poses, first))

    def both(name: str) -> Array:
        return np.concatenate([arm[name].reshape(PHASE_SAMPLES, -1) for arm in arms], axis=1)

    v, w, a = unit.rate[:, None], unit.rate[:, None] ** 2, unit.second[:, None]
    way = line.box[1] - line.box[0]
    q_rate = both("q_first") * v
    q_second = both("q_second") * w + both("q_first") * a
    rate, second_rate = v * way, a * way
    third = CubicSpline(unit.time, q_second).derivative()(unit.time)
    payload = model.workcell.payload
    joint_speed, joint_acceleration = map(
        model.workcell.stack_joint_limits, ("velocity_max", "acceleration_max")
    )
    jerk = JerkLimits.from_workcell(model.workcell) or JerkLimits(np.full(q.shape[1], np.inf))
    gentle = min(payload.acceleration_max, LIFTING_ACCELERATION)
    most = float(np.abs(unit.third).max())
    duration = max(
        PEAK_RATE * line.length / line.speed,
        float((np.abs(q_rate) / joint_speed).max()),
        float((np.abs(q_second) / joint_acceleration).max()) ** 0.5,
        float(np.linalg.norm(rate[:, :3], axis=1).max()) / payload.velocity_max,
        (float(np.linalg.norm(second_rate[:, :3], axis=1).max()) / gentle) ** 0.5,
        float((np.abs(third) / jerk.joints).max()) ** (1.0 / 3.0),
        (most * float(np.linalg.norm(way[:3])) / jerk.payload) ** (1.0 / 3.0),
    )
    T = max(at_even_steps(duration, TICK), TICK)
    moving = both("torque_by_acceleration") * a + both("torque_by_speed") * w
    return PhaseMotion(
        first=own[0].shape[1],
        time=T * unit.time,
        pose=box,
        rate=rate / T,
        second_rate=second_rate / T**2,
        q=q,
        q_rate=q_rate / T,
        q_second=q_second / T**2,
        own_torque=moving / T**2 + both("torque_at_rest"),
        wrench_torque=both("wrench_torque").reshape(PHASE_SAMPLES, -1, 6),
    )


def standing_still(motion: PhaseMotion, sample: int, time: Array) -> PhaseMotion:
    """Return a motion that rests in the box pose and joint positions of one sample of another
    motion.

    Args:
        motion: motion with the sample.
        sample: index of the sample.
        time: (n,) times of the result, from the beginning of the phase [s].
    """
    arrays = {
        name: np.repeat(values[sample][None], len(time), axis=0)
        for name, values in vars(motion).items()
        if isinstance(values, np.ndarray)
    }
    arrays |= {name: np.zeros_like(arrays[name]) for name in _MOVING}
    return PhaseMotion(motion.first, **arrays | {"time": time})


def carry_motion(model: TimingModel, carry: Carry) -> PhaseMotion:
    """Return the timed motion of a carry, followed by rest until a whole number of ticks (`TICK`)
    has passed.

    Args:
        model: timing model of the workcell.
        carry: the carry.
    """
    q, pose = np.ascontiguousarray(carry.q), np.ascontiguousarray(carry.pose)
    time = carry.time - carry.time[0]
    motion = PhaseMotion(
        first=carry.arms[0].q.shape[1],
        time=time,
        pose=pose,
        rate=carry.rate,
        second_rate=carry.second_rate,
        q=q,
        q_rate=carry.stack_arms("q_rate"),
        q_second=carry.stack_arms("q_second"),
        own_torque=carry.stack_arms("own_torque"),
        wrench_torque=model.wrench_torque(q, pose),
    )
    end = max(at_even_steps(float(time[-1]), TICK), time[-1])
    still = vars(standing_still(motion, -1, np.array([time[-1], end])))
    # Torques that hold the bare arms still.
    arms, zero = joints_of(model.workcell, q[-1:]), np.zeros((1, 6))
    parts = [model.arm_motion(arm, own, pose[-1:], zero) for arm, own in enumerate(arms)]
    torque = np.concatenate([part["torque_at_rest"][0] for part in parts])
    still["own_torque"] = np.array([torque, torque])
    names = [name for name in still if name != "first"]
    joined = {name: np.concatenate([getattr(motion, name), still[name]]) for name in names}
    return PhaseMotion(motion.first, **joined)


USE_TOLERANCE = 1.005
"""A job is refused if a limit is used beyond this ratio."""

_SAME_TIME = 1e-9

_NO_JUMP = 1e-6


def holding(
    model: TimingModel, settings: SqueezeSettings, motions: Sequence[PhaseMotion]
) -> tuple[list[Force], Squeeze]:
    """Compute the forces in consecutive phases in which the box is held.

    Args:
        model: timing model of the workcell.
        settings: settings of the commanded forces.
        motions: motion of each phase, in order of time.

    Returns:
        Forces of each phase, in this order; and a record of how the commanded forces were computed.

    Raises:
        SettingsError: the uncertainty leaves no friction or contact patch.
    """
    ends = np.cumsum([0.0, *(motion.duration for motion in motions)])
    time = np.concatenate([m.time + at for m, at in zip(motions, ends[:-1], strict=True)])
    box = BoxMotion(
        *(
            np.ascontiguousarray(np.concatenate([getattr(motion, name) for motion in motions]))
            for name in ("pose", "rate", "second_rate")
        )
    )
    load = model.load(box.pose, box.rate, box.second_rate)
    least, wrench = load["normal_force"], np.stack([load["wrench_1"], load["wrench_2"]], axis=1)
    extra, squeeze = extra_normal_force(model.workcell, settings, time, box, least)
    normal = command_model(model.workcell).raised(least, extra, squeeze.leader)
    wrench = wrench + extra[:, None, None] * unit_squeeze(model.workcell, box.pose, squeeze.leader)
    cuts = np.cumsum([len(motion.time) for motion in motions])[:-1]
    parts = zip(*(np.split(values, cuts) for values in (normal, least, wrench)), strict=True)
    return [Force(*part) for part in parts], squeeze


def pressing(
    motion: PhaseMotion, hold: Force, sample: int, rate: float
) -> tuple[PhaseMotion, Force]:
    """Compute a phase in which the contact forces rise from zero, or fall to zero, while box and
    arms stand still.

    All forces rise with the same profile in time, and the support of the box is relieved as they
    rise. So the ratio of tangential to normal force is that of the held box throughout.

    Args:
        motion, hold: motion and forces of the phase that follows a rise, or precedes a fall.
        sample: 0 for a rise to the first sample of that phase, -1 for a fall from its last sample.
        rate: largest rate of change of a normal force [N/s].

    Returns:
        Motion and forces of the phase.
    """
    peak = float(hold.normal[sample].max())
    duration = at_even_steps(PEAK_RATE * peak / rate, TICK)
    share = rest_to_rest_profile(duration, PHASE_SAMPLES).value[:: 1 if sample == 0 else -1]

    def scaled(values: Array) -> Array:
        return np.asarray(np.multiply.outer(share, values[sample]))

    force = Force(scaled(hold.normal), scaled(hold.least), scaled(hold.wrench))
    return standing_still(motion, sample, np.linspace(0.0, duration, PHASE_SAMPLES)), force


def waiting(motion: PhaseMotion, sample: int, duration: float) -> tuple[PhaseMotion, Force]:
    """Compute a phase without forces in which the arms stand still while hands (cups, magnets,
    grippers) grip or release the box.

    Args:
        motion: motion of the phase before or after.
        sample: 0 to stand where this motion begins, -1 to stand where it ends.
        duration: least duration of the phase [s]; it is rounded up to whole ticks.

    Returns:
        Motion and forces of the phase; the forces are zero.
    """
    time = np.linspace(0.0, at_even_steps(duration, TICK), PHASE_SAMPLES)
    still = standing_still(motion, sample, time)
    return still, zero_forces(still)


def zero_forces(motion: PhaseMotion) -> Force:
    """Return zero forces for a motion in which the pads touch nothing."""
    n = len(motion.time)
    return Force(np.zeros((n, 2)), np.zeros((n, 2)), np.zeros((n, 2, 6)))


def unit_squeeze(workcell: Workcell, pose: Array, leader: int = 0) -> Array:
    """Compute by how much the wrenches of both robots on the box change per newton of additional
    commanded force.

    Args:
        workcell: the workcell.
        pose: (n, 6) box poses [m, rad].
        leader: index of the position-controlled arm.

    Returns:
        Change (n, 2, 6) of force [N/N] and moment about the robot's nominal contact point [N m/N],
        world axes.
    """
    turned = box_rotation(workcell.task.orientation, pose)
    wrenches = contact_model(workcell).squeeze_wrenches(leader).reshape(2, 2, 3)
    return np.asarray(np.einsum("nij,abj->nabi", turned, wrenches).reshape(len(pose), 2, 6))


def phase_use(
    workcell: Workcell, motion: PhaseMotion, force: Force, jerk: JerkLimits | None = None
) -> dict[str, float]:
    """Compute the largest ratio of value to limit in a phase, for each limit that applies to every
    phase.

    Joint torques are those of the arms' motion and weight plus those of the commanded contact
    wrenches. Friction and pressure are not included: the timing checks them with the planned
    forces, and pressing harder only reduces their ratios.

    Args:
        workcell: the workcell.
        motion, force: motion and forces of the phase.
        jerk: limits on jerk; None for no such limits.

    Returns:
        Ratios by name of the limit; above 1 the limit is exceeded.
    """

    effort = motion.own_torque + motion.contact_effort(force.wrench)
    payload, bounded = workcell.payload, dict[str, float]()
    forces = contact_model(workcell).force_use(force.normal, force.least)
    if jerk is not None and np.isfinite(jerk.joints).any():
        bounded["joint jerk"] = _most(_jerk(motion.time, motion.q_second) / jerk.joints)
    if jerk is not None and np.isfinite(jerk.payload):
        box = _length(_jerk(motion.time, motion.second_rate))
        bounded["payload jerk"] = _most(box / jerk.payload)
    return bounded | {
        **joint_use(workcell, motion.q, motion.q_rate, motion.q_second),
        "joint torque": _most(np.abs(effort) / workcell.stack_joint_limits("torque_max")),
        "payload velocity": _most(_length(motion.rate) / payload.velocity_max),
        "payload acceleration": _most(_length(motion.second_rate) / payload.acceleration_max),
        **{name: _most(ratio) for name, ratio in forces.items()},
    }


def joint_use(workcell: Workcell, q: Array, rate: Array, second: Array) -> dict[str, float]:
    """Compute the largest ratio of joint positions, velocities and accelerations to their limits.

    A ratio of positions is 0 in the middle of the joint's range and 1 at its ends.

    Args:
        workcell: the workcell.
        q, rate, second: (n, joints) joint positions of both arms [rad], and their first and second
            time derivative.

    Returns:
        Ratios by the names 'joint position', 'joint velocity' and 'joint acceleration'.
    """
    lower, upper = map(workcell.stack_joint_limits, ("position_lower", "position_upper"))
    return {
        "joint position": _most(np.abs(2.0 * q - lower - upper) / (upper - lower)),
        "joint velocity": _most(np.abs(rate) / workcell.stack_joint_limits("velocity_max")),
        "joint acceleration": _most(
            np.abs(second) / workcell.stack_joint_limits("acceleration_max")
        ),
    }


def _jerk(time: Array, second: Array) -> Array:
    """Compute magnitudes (n - 1, k) of jerk between samples as differences of accelerations;
    infinite at jumps, where two samples have the same time.

    Args:
        time: (n,) times [s].
        second: (n, k) accelerations.
    """
    steps, change = np.diff(time)[:, None], np.abs(np.diff(second, axis=0))
    jumps = np.where(change > _NO_JUMP, np.inf, 0.0)
    return np.where(steps > _SAME_TIME, change / np.maximum(steps, _SAME_TIME), jumps)


def _most(ratio: Array) -> float:
    return float(ratio.max())


def _length(rate: Array) -> Array:
    return np.asarray(np.linalg.norm(rate[:, :3], axis=1))
