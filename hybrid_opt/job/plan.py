"""Plan of a whole job around the timing of a carry. docs/explanation/job.md explains the phases.

Pads approach along the contact normals, press while the box stands, take over its weight with the
press, lift it off, carry it, set it down, let go, and retreat. Hands that hold by themselves take
hold before they take over the weight (`ContactModel.closing`). Every phase but the carry follows a
smooth profile from rest to rest (`hybrid_opt.job.motions`).

Contact rules. A body of an arm's last link that lies behind the plane of the pad is not checked
against the box: the plane separates both at the grasp, and wherever the pad is withdrawn along the
contact normal. Every other body of an arm has to stay clear of the box. The box may touch the
bodies that it stands on until it is lifted, and penetrate them by at most `RESTING_TOLERANCE`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Protocol

import numpy as np

from codegen.function import NumericFunction
from hybrid_opt.carry import Carry, joints_of
from hybrid_opt.collision.certify import Certificate, SampledPath, certificates, certify
from hybrid_opt.collision.checker import (
    FCL_RESOLUTION,
    RESTING_TOLERANCE,
    BodyDistances,
    CollisionChecker,
)
from hybrid_opt.compiled_cell import CACHED_WORKCELLS, CompiledCell
from hybrid_opt.errors import JobError
from hybrid_opt.job.motions import (
    PHASE_SAMPLES,
    USE_TOLERANCE,
    Straight,
    carry_motion,
    follow_line,
    holding,
    lines_around,
    phase_use,
    pressing,
    rest_to_rest_profile,
    solve_joints_at,
    time_line,
    waiting,
    zero_forces,
)
from hybrid_opt.job.records import SWITCHES, Job, Phase, PhaseMotion
from hybrid_opt.robust.squeeze import Squeeze, SqueezeSettings, commanded_forces
from hybrid_opt.timing.jerk import applicable_jerk_limits, has_rest_at_ends, without_jumps
from hybrid_opt.timing.model import TimingModel
from hybrid_opt.timing.records import JerkLimits, Timing
from hybrid_opt.timing.smoothing import LARGEST_WIDTH, SMOOTHING_WIDTH
from symbolic.array import Array, interpolated
from symbolic.contact.registry import contact_model
from symbolic.errors import SettingsError
from symbolic.geometry.bodies import CollisionBody
from symbolic.geometry.pairs import ActivePair, CellGeometry, build_geometry, ignored_pairs
from symbolic.geometry.pieces import support
from symbolic.path.spline import extended_waypoints
from symbolic.records import PAYLOAD_NAME, AllowedContact, Handling, Waypoint, Workcell

LARGEST_DROP = 0.3
"""Largest distance below the carry's ends within which a support of the box is looked for [m]."""

MOST_STEPS = 300
BEHIND_PAD = "behind the pad: the contact plane keeps them apart"

SAME_PLANE = 1e-9
"""An approach does not cross the plane of a pad if its cosine with the pad's normal is above the
negative of this."""

CHECK_STRIDE = 10
"""Every so many samples of a straight motion are checked for collisions."""


@dataclass(frozen=True)
class SupportedPose:
    """Pose of the box on its support, straight below an end of the carry.

    Attributes:
        pose: (6,) pose of the box on the support, world frame [m, rad].
        height: distance by which the box was lowered to this pose [m].
        bodies: names of the supporting bodies; empty if there are none.
    """

    pose: Array
    height: float
    bodies: tuple[str, ...]


@dataclass(frozen=True)
class StraightMotions:
    """Straight motions and supports before a carry and after it.

    Attributes:
        checker: collision checker of the whole job.
        lines: two lists, the straight motions before and after the carry; each list begins with the
            motion next to the carry.
        stands_on: names of the bodies that support the box before and after the carry.
    """

    checker: CollisionChecker
    lines: tuple[list[Straight], list[Straight]]
    stands_on: tuple[tuple[str, ...], tuple[str, ...]]

    def followed(
        self, workcell: Workcell, posture: NumericFunction, q: Array
    ) -> Iterator[tuple[int, Straight, Array]]:
        """Compute the joint positions along each straight motion, from the carry outwards.

        Args:
            workcell: the cell.
            posture: compiled `symbolic.robot.arm.posture_function`.
            q: (2, joints) joint positions of both arms at the beginning and end of the carry [rad
                or m].

        Yields:
            Side (0 before the carry, 1 after it), straight motion, and joint positions of both arms
            (`PHASE_SAMPLES`, joints) [rad or m].

        Raises:
            JobError: an arm does not reach a pad pose within its joint range.
        """
        for side, (lines, known) in enumerate(zip(self.lines, q, strict=True)):
            for line in lines:
                way = follow_line(workcell, posture, line, known, at_end=side == 0)
                yield side, line, way
                known = way[-side]


class JobCollisions:
    """Collision model of the jobs of one workcell. Threads must not share one.

    Attributes:
        geometry: bodies, and pairs of bodies to check: the pairs of the carry, and pairs of an
            arm's body and the box.
    """

    def __init__(self, compiled: CompiledCell, everywhere: bool = False) -> None:
        """Load or build the compiled functions of the collision model.

        Args:
            compiled: compiled functions of the workcell.
            everywhere: True if pads may approach from any direction, False if along their contact
                normals.

        Raises:
            DualArmError: the model cannot be built.
        """
        self._workcell = compiled.workcell
        self.geometry = job_geometry(compiled.workcell, everywhere)
        self._functions = compiled.screening

    def standing(self, pose: Array, height: float | None) -> SupportedPose:
        """Lower the box straight down from an end of the carry to its support.

        Args:
            pose: (6,) pose of the box at an end of the carry, world frame [m, rad].
            height: distance by which to lower the box [m]; None to lower it until it touches a
                body. Without a body within `LARGEST_DROP` it is then not lowered.
        """
        distances = BodyDistances(self.geometry, RESTING_TOLERANCE)
        payload, bodies = self.geometry.index(PAYLOAD_NAME), self.geometry.bodies
        pairs = [
            (p.first, p.second) for p in self.geometry.active if payload in (p.first, p.second)
        ]
        others = [first + second - payload for first, second in pairs]
        # What stands still and the box must not run into.
        below = np.array(
            [other for other in others if bodies[other].frame.kind == "world"], dtype=np.intp
        )
        still = [np.zeros((1, len(robot.torque_max))) for robot in self._workcell.robots]

        def gaps(drop: float) -> Array:
            lowered = _lowered(pose, drop)
            placed = self._functions["piece_poses"].batch(lowered[None], *still)
            one = np.zeros(len(below), dtype=np.intp)
            lower, _ = distances.bounds(placed, one, one + payload, below)
            return np.maximum(lower, 0.0)

        found = 0.0 if height is None else height
        if height is None and len(below):
            found = standing_height(lambda drop: float(gaps(drop).min()))
        touched = gaps(found) <= RESTING_TOLERANCE
        names = [bodies[body].name for body in below[touched].tolist()]
        return SupportedPose(_lowered(pose, found), found, tuple(names))

    def straight_motions(self, handling: Handling, pose: Array) -> StraightMotions:
        """Plan the straight motions before and after a carry.

        Args:
            handling: heights, speeds and stand-off of the job.
            pose: (2, 6) box poses at the beginning and end of the carry [m, rad].
        """
        heights = (handling.lift_height, handling.set_down_height)
        before, after = (self.standing(*each) for each in zip(pose, heights, strict=True))
        stands = (before.pose, after.pose)
        lines = lines_around(self._workcell, handling, stands, pose)
        checker = self.checker((before, after))
        return StraightMotions(checker, lines, (before.bodies, after.bodies))

    def checker(self, places: Sequence[SupportedPose]) -> CollisionChecker:
        """Build the collision checker of a job, in which the box may touch the supporting bodies at
        the given poses.

        Args:
            places: supported poses of the box before and after the carry.
        """
        task = self._workcell.task
        poses = tuple(Waypoint(place.pose, place.pose) for place in places)
        contacts = tuple(
            AllowedContact(body, place.height + RESTING_TOLERANCE)
            for place in places
            for body in place.bodies
        )
        task = replace(
            task,
            waypoints=(*task.waypoints, *poses),
            allowed_contacts=(*task.allowed_contacts, *contacts),
        )
        cell = replace(self._workcell, task=task)
        return CollisionChecker(replace(self.geometry, workcell=cell), self._functions)


def standing_height(gap: Callable[[float], float]) -> float:
    """Compute by how much a box is lowered until it stands [m]; 0 if nothing is within
    `LARGEST_DROP` below it.

    Args:
        gap: function that returns the distance [m] between the box, lowered by its argument [m],
            and the nearest body that may support it; 0 if they touch.
    """
    found = 0.0
    for _ in range(MOST_STEPS):
        distance = gap(found)
        found += distance
        if distance <= FCL_RESOLUTION or found > LARGEST_DROP:
            break
    return 0.0 if found > LARGEST_DROP else found


def job_geometry(workcell: Workcell, everywhere: bool = False) -> CellGeometry:
    """Return the bodies of a cell and the pairs of bodies that a job has to check for collisions.

    Bodies of an arm that lie behind the plane of its pad are not checked against the box.

    Args:
        workcell: the cell.
        everywhere: True to check also the bodies behind a pad against the box.

    Raises:
        CollisionModelError: a shape is unusable, or an ignored pair names no body.
    """
    geometry = build_geometry(workcell)
    bodies, payload = geometry.bodies, geometry.index(PAYLOAD_NAME)
    ignored = ignored_pairs(workcell, bodies)
    active, excluded = list(geometry.active), []
    for pair in geometry.excluded:
        of_box = payload in (pair.first, pair.second)
        other = bodies[pair.first + pair.second - payload] if of_box else None
        if (
            other is None
            or not other.group.startswith("robot")
            or frozenset((other.name, PAYLOAD_NAME)) in ignored
        ):
            excluded.append(pair)
        elif not everywhere and _behind_pad(other, geometry):
            excluded.append(replace(pair, reason=BEHIND_PAD))
        else:
            active.append(ActivePair(pair.first, pair.second))
    return replace(geometry, active=tuple(active), excluded=tuple(excluded))


def _behind_pad(body: CollisionBody, geometry: CellGeometry) -> bool:
    """Return True if a body moves rigidly with the pads of an arm and lies behind the plane of one
    of them, on the side away from the box. Pads whose normal points against the arm's direction of
    approach do not count.

    Args:
        body: body of the cell.
        geometry: bodies and arms of the cell.
    """
    arm, workcell = body.frame.robot, geometry.workcell
    if arm < 0 or body.frame.joint != len(geometry.arms[arm].axes) - 1:
        return False
    way = contact_model(workcell).approach(arm)
    for pad, robot in zip(workcell.pads, workcell.pad_robots, strict=True):
        if robot != arm or pad.T_box_pad[:3, 2] @ way < -SAME_PLANE:
            continue
        T_joint_pad = geometry.arms[arm].T_joint_box @ pad.T_box_pad
        normal, origin = T_joint_pad[:3, 2], T_joint_pad[:3, 3]
        ahead = max(float(support(piece, normal[None])[0]) for piece in body.pieces)
        if ahead - normal @ origin <= RESTING_TOLERANCE:
            return True
    return False


def _lowered(pose: Array, drop: float) -> Array:
    lowered = np.array(pose, dtype=float)
    lowered[2] -= drop
    return lowered


def describe_obstruction(
    workcell: Workcell,
    collisions: JobCollisions,
    posture: NumericFunction,
    pose: Array,
    q: Array,
) -> str:
    """Describe the first straight motion before or after a carry that collides or leaves an arm's
    reach.

    The result is '' if every motion is reached and free of collisions at the checked samples.

    Args:
        workcell: cell with two opposite round pads.
        collisions: collision model of the cell's jobs.
        posture: compiled `symbolic.robot.arm.posture_function`.
        pose: (2, 6) poses of the box at the beginning and end of the carry [m, rad].
        q: (2, joints) joint positions of both arms at these poses [rad or m].
    """
    around = collisions.straight_motions(workcell.handling, pose)
    share = rest_to_rest_profile(1.0, PHASE_SAMPLES).value[::CHECK_STRIDE]
    try:
        for _, line, way in around.followed(workcell, posture, q):
            poses, joints = line.at(share)[0], joints_of(workcell, way[::CHECK_STRIDE])
            touch = around.checker.check(poses, *joints).first_touch
            if touch is not None:
                return f"{line.name.replace('_', ' ')}: {touch}"
    except JobError as error:
        return str(error)
    return ""


PATH_SAMPLES = 201
"""Number of samples of the carry's joints; Newton's method reaches every pose between them."""

_SAME_POSTURE = 7
"""Carries end in the same posture if their joint positions agree to so many decimals [rad, m]."""

_MOST_KNOWN = 8
"""Number of different carry ends whose straight motions are cached."""

FIRST_POINTS = 11
"""Number of grid points at which the certification of a straight motion starts."""


class JobModel:
    """Planner of the jobs of one workcell. Threads must not share one.

    Attributes:
        workcell: the cell.
        timing: timing model of the workcell.
    """

    def __init__(self, cell: Workcell | CompiledCell, timing: TimingModel | None = None) -> None:
        """Load or build the compiled functions.

        Args:
            cell: the workcell; give a compiled one to share its functions.
            timing: timing model of the workcell; built if None.

        Raises:
            DualArmError: the model cannot be built.
        """
        compiled = CompiledCell.of(cell)
        self.workcell = compiled.workcell
        self.timing = TimingModel(compiled) if timing is None else timing
        self._posture: NumericFunction = compiled.evaluators["posture"]
        self._collisions = JobCollisions(compiled)
        self._known: dict[
            tuple[Handling, bytes], tuple[StraightMotions, list[Phase], list[Phase]]
        ] = {}

    def plan(
        self,
        timing: Timing,
        squeeze: SqueezeSettings | None = None,
        smoothing: float = SMOOTHING_WIDTH,
        handling: Handling | None = None,
        within_jerk: bool = True,
    ) -> Job:
        """Plan the whole job around a timed carry.

        Jumps of acceleration at the ends of the timing are removed first. If the workcell limits
        jerk and `within_jerk` is True, the carry is timed anew within these limits, which takes
        about a second. Otherwise the timing is averaged over a moving window.

        Args:
            timing: drivable timing of a carry of this workcell.
            squeeze: settings of the commanded forces; None for the defaults.
            smoothing: half the width of the moving window [s]; 0 to keep the timing unchanged, also
                in a workcell that limits jerk.
            handling: heights, speeds and stand-off of the job; None for the workcell's own.
            within_jerk: False to ignore the workcell's limits on jerk.

        Raises:
            SettingsError: the timing failed, or the squeeze is not possible.
            JobError: an arm does not reach a pad pose, bodies collide, or a limit is exceeded.
        """
        if timing.carry is None or not timing.ok:
            raise SettingsError(
                f"there is no timing to export ({timing.status}: {timing.reason}); export one "
                "that robots can drive",
                code="no-timing",
            )
        if not 0.0 <= smoothing <= LARGEST_WIDTH:
            raise SettingsError(
                f"smoothing over {smoothing:g} s: allowed is 0 to {LARGEST_WIDTH:g} s"
            )
        jerk = applicable_jerk_limits(self.workcell, timing.limits) if within_jerk else None
        timing = without_jumps(self.timing, timing, jerk, smoothing)
        carry = timing.driven
        handling = handling or self.workcell.handling
        around, (*before, first), (*after, last) = self._around(carry, handling)
        motion = carry_motion(self.timing, carry)
        middle = Phase(
            "carry", 0.0, motion, zero_forces(motion), self._proof(around.checker, carry), {}
        )
        loaded = [*before[::-1], middle, *after]
        settings = squeeze or SqueezeSettings()
        forces, chosen = holding(self.timing, settings, [part.motion for part in loaded])
        held = [replace(part, force=force) for part, force in zip(loaded, forces, strict=True)]

        def standing(name: str, end: Phase, k: int) -> Phase:
            if name in SWITCHES:
                found = waiting(held[k].motion, k, handling.grip_time)
            else:
                found = pressing(held[k].motion, held[k].force, k, handling.pressing_rate)
            return Phase(name, 0.0, *found, end.certificate, {})

        contact = contact_model(self.workcell)
        closing = [standing(name, first, 0) for name in contact.closing]
        opening = [standing(name, last, -1) for name in contact.opening]
        return Job(
            self.workcell,
            timing,
            tuple(self._phases([first, *closing, *held, *opening, last], timing, jerk)),
            chosen,
            around.stands_on,
            self.timing.joint_names,
        )

    def _around(
        self, carry: Carry, handling: Handling
    ) -> tuple[StraightMotions, list[Phase], list[Phase]]:
        """Plan and time the straight motions before and after a carry.

        Results are cached for carries with the same ends.

        Args:
            carry: the carry.
            handling: heights, speeds and stand-off of the motions.

        Returns:
            The straight motions, their phases before the carry, and their phases after it. Each
            list starts with the phase next to the carry.
        """
        pose, q = carry.pose[[0, -1]], carry.q[[0, -1]].round(_SAME_POSTURE)
        key = handling, pose.tobytes() + q.tobytes()
        if key in self._known:
            return self._known[key]
        if len(self._known) >= _MOST_KNOWN:
            self._known.clear()
        around = self._collisions.straight_motions(handling, pose)
        found: tuple[list[Phase], list[Phase]] = ([], [])
        for side, line, way in around.followed(self.workcell, self._posture, q):
            motion = time_line(self.timing, line, way)
            proof = self._free(around.checker, line, motion)
            found[side].append(Phase(line.name, 0.0, motion, zero_forces(motion), proof, {}))
        self._known[key] = around, *found
        return self._known[key]

    def _proof(self, checker: CollisionChecker, carry: Carry) -> Certificate:
        """Certify, by the job's collision checker, that a carry is free of collisions."""
        u = np.linspace(0.0, 1.0, PATH_SAMPLES)
        q = interpolated(u, carry.parameter, carry.q)
        task = self.workcell.task
        path = SampledPath(task, extended_waypoints(task, carry.x), *joints_of(self.workcell, q))
        return certificates(checker, self._posture, [path])[0]

    def _free(self, checker: CollisionChecker, line: Straight, motion: PhaseMotion) -> Certificate:
        """Certify, by the job's collision checker, that the motion along a line is free of
        collisions.
        """
        share = rest_to_rest_profile(1.0, PHASE_SAMPLES).value

        def at(u: Array) -> tuple[Array, Array, Array]:
            guess = interpolated(u, share, motion.q)
            q = solve_joints_at(self.workcell, self._posture, line, u, guess)
            return line.at(u)[0], *joints_of(self.workcell, q)

        return certify(checker, at, np.linspace(0.0, 1.0, FIRST_POINTS))

    def _phases(
        self, drafts: Sequence[Phase], timing: Timing, jerk: JerkLimits | None
    ) -> Iterator[Phase]:
        """Yield the phases in order of time, with their start times and with the use of each limit.

        Args:
            drafts: phases in order of time, without start times.
            timing: timing of the carry.
            jerk: limits on jerk; None for no such limits.

        Raises:
            JobError: a phase collides or exceeds a limit.
        """
        begin, contact = 0.0, contact_model(self.workcell)
        for draft in drafts:
            # Jumps that a carry is to keep are reported elsewhere.
            jumps = draft.name == "carry" and not has_rest_at_ends(timing)
            kept = None if jumps else jerk
            use = phase_use(self.workcell, draft.motion, draft.force, kept)
            if draft.name == "carry":
                # The box's turning and the contacts, which no other phase uses more.
                use = {key: excess.ratio for key, excess in timing.use.items()} | use
            title, found = draft.name.replace("_", " "), draft.certificate
            if not found.is_free:
                raise JobError(
                    f"{title}: {100.0 * found.at_parameter:.0f} % along its way {found.problem}; "
                    "change stand_off, lift_height or set_down_height under [handling] (a height "
                    "of 0 hands the box over in the air), or choose another carry",
                    code="in-the-way",
                )
            name, ratio = max(use.items(), key=lambda item: item[1])
            if ratio > USE_TOLERANCE:
                less = f"{contact.relief}, or " if contact.relief else ""
                raise JobError(
                    f"{title}: uses {100.0 * ratio:.1f} % of the limit on {name}; {less}choose a "
                    "slower timing",
                    code="beyond-a-limit",
                )
            yield replace(draft, begin=begin, use=use)
            begin += draft.duration


@lru_cache(maxsize=CACHED_WORKCELLS)
def job_model(timing: TimingModel) -> JobModel:
    """Return the job planner of a timing model's workcell; repeated calls return the same one."""
    return JobModel(timing.compiled, timing)


@dataclass(frozen=True)
class CommandedForces:
    """Normal forces to command along a timed carry, with the job around the carry.

    Attributes:
        forces: (n, 2) normal force of each robot at the samples of the carry [N].
        squeeze: record of how the forces were computed.
        job: the whole job; None if no job can be planned. The forces are then computed for the
            carry alone.
        problem: reason why no job can be planned, else None.
    """

    forces: Array
    squeeze: Squeeze
    job: Job | None
    problem: JobError | None = None


def command_forces(
    model: JobModel, timing: Timing, settings: SqueezeSettings | None = None
) -> CommandedForces:
    """Compute the normal forces to command along a timed carry: those of its job or, if no job is
    possible, those of the carry alone.

    Args:
        model: job planner of the carry's workcell.
        timing: timing of the carry, without jumps of acceleration.
        settings: settings of the commanded forces; None for the defaults.

    Returns:
        The forces, with the job, or with the reason why there is none.

    Raises:
        SettingsError: the timing failed, or the uncertainty leaves no friction or patch.
    """
    settings = settings or SqueezeSettings()
    try:
        job = model.plan(timing, settings)
    except JobError as error:
        forces, squeeze = commanded_forces(model.workcell, timing.driven, settings)
        return CommandedForces(forces, squeeze, None, error)
    carried = job.phase("carry")
    along = (carried.motion.time, carried.force.normal)
    time = job.timing.driven.time
    normal = np.column_stack([np.interp(time, along[0], force) for force in along[1].T])
    return CommandedForces(normal, job.squeeze, job)


_model = lru_cache(maxsize=CACHED_WORKCELLS)(JobModel)


class HasTiming(Protocol):
    """An object with the timing of a carry, such as a recommendation."""

    @property
    def timing(self) -> Timing:
        """Timing of the carry as robots drive it."""


def plan_job(
    timing: Timing | HasTiming,
    squeeze: SqueezeSettings | None = None,
    smoothing: float = SMOOTHING_WIDTH,
) -> Job:
    """Plan the whole job around a timed or recommended carry.

    Args:
        timing: drivable timing, or an object with one.
        squeeze: settings of the commanded forces; None for the defaults.
        smoothing: half the width of the window over which a timing with jumps of acceleration is
            averaged [s]; 0 to keep such a timing. In a workcell with limits on jerk any other value
            has no effect, because the carry is then timed anew within these limits.

    Raises:
        SettingsError: the timing failed, or the squeeze is not possible.
        JobError: an arm does not reach a pad pose, bodies collide, or a limit is exceeded.
    """
    timing = timing if isinstance(timing, Timing) else timing.timing
    if timing.carry is None:
        raise SettingsError(
            f"there is no timing to export ({timing.status}: {timing.reason})", code="no-timing"
        )
    return _model(timing.carry.workcell).plan(timing, squeeze, smoothing)
