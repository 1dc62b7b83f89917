"""Checks before anything is compiled, with CasADi's interpreter: the box alone, postures of the
cell, and a proposed carry by the evaluator."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from codegen.interpreted import interpret
from hybrid_opt.carry import Judgement
from hybrid_opt.collision.certify import LostPathError
from hybrid_opt.collision.checker import CollisionChecker
from hybrid_opt.compiled_cell import InterpretedCell
from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.evaluate.explanation import explain
from hybrid_opt.job.plan import JobCollisions, describe_obstruction
from hybrid_opt.static_hold import static_hold_error
from symbolic.array import Array
from symbolic.cell_model import (
    CellBodies,
    CellModel,
    build_cell_bodies,
    build_cell_model,
)
from symbolic.contact.registry import contact_model
from symbolic.functions import motion_function
from symbolic.geometry.bodies import WORLD, MeshReader, shape_pieces
from symbolic.geometry.pairs import CellGeometry
from symbolic.geometry.pieces import Piece, support
from symbolic.geometry.separation import coal_distance
from symbolic.records import PAYLOAD_NAME, Handling, Workcell
from symbolic.records.poses import box_placement
from symbolic.records.task import initial_decision
from symbolic.robot.branches import StartBranch

MARGINS = (0.01, 0.004, 0.0015, 0.0005, 0.0)
"""Clearances beyond the cell's tolerance that a first path may keep [m]. The widest possible one is
used."""


CONTACT_STEP = 0.02
"""Step along a straight motion of the box at which contact is checked [m]."""

LEVEL = 0.1
"""A motion has a left and a right side if its level share exceeds this."""


class PayloadSceneChecker:
    """Collision checker of the box and the environment, without the arms."""

    def __init__(self, workcell: Workcell) -> None:
        """Prepare the shapes of box and environment.

        Args:
            workcell: the cell.
        """
        meshes = MeshReader()
        self._orientation = workcell.task.orientation
        self._met: dict[tuple[bytes, bytes], bool] = {}
        self._box = shape_pieces(workcell.payload.solid, np.eye(4), PAYLOAD_NAME, meshes)
        self._names = [body.name for body in workcell.environment]
        self._standing = [
            shape_pieces(body.shape, body.pose, body.name, meshes) for body in workcell.environment
        ]

    def meets(self, path: Array) -> bool:
        """Return True if the box collides with a body of the environment at one of these poses.

        Args:
            path: (n, 6) poses of the box [m, rad].
        """
        return any(
            self._meets(box, k) for box in self._boxes(path) for k in range(len(self._names))
        )

    def is_between(self, begin: Array, end: Array, shares: Array) -> bool:
        """Return True if the box collides with a body of the environment on a straight motion.
        Results are cached by the ends of the motion.

        Args:
            begin, end: (6,) box poses at the ends [m, rad].
            shares: (n,) points of the motion that are checked: 0 is its beginning, 1 its end.
        """
        key = begin.tobytes(), end.tobytes()
        if key not in self._met:
            self._met[key] = self.meets(begin + shares[:, None] * (end - begin))
        return self._met[key]

    def sides_passed(self, path: Array) -> tuple[str, ...]:
        """Name the side on which a path of the box passes each obstacle of the straight motion
        between its ends. Bodies that the box touches at an end, such as its support, do not count.

        Args:
            path: (n, 6) poses of the box [m, rad].

        Returns:
            Texts such as 'over post', 'left of post' (looking along the motion), 'between post and
            wall' or 'through frame'; empty if the straight motion is free.
        """
        n = max(int(np.ceil(np.linalg.norm(path[-1, :3] - path[0, :3]) / CONTACT_STEP)), 2)
        straight = self._boxes(np.linspace(path[0], path[-1], n + 1))
        ends, between = (straight[0], straight[-1]), straight[1:-1]
        way, placed = path[-1, :3] - path[0, :3], self._boxes(path)
        beside = {
            name: standing
            for k, (name, standing) in enumerate(zip(self._names, self._standing, strict=True))
            if not any(self._meets(box, k) for box in ends)
        }
        found: dict[str, None] = {}
        for k, name in enumerate(self._names):
            if name in beside and any(self._meets(box, k) for box in between):
                found[_passage(placed, beside, name, way)] = None
        return tuple(found)

    def _boxes(self, path: Array) -> list[tuple[Piece, ...]]:
        placements = box_placement(self._orientation, path)
        return [tuple(piece.moved(T) for piece in self._box) for T in placements]

    def _meets(self, box: tuple[Piece, ...], k: int) -> bool:
        return coal_distance(box, self._standing[k]) <= 0.0


def _passage(
    boxes: list[tuple[Piece, ...]], standing: Mapping[str, tuple[Piece, ...]], name: str, way: Array
) -> str:
    """Return a text on how the box passes a fixed body: through it, between it and another body, or
    on which side of it.

    'through' means that parts of the body lie on two opposite sides of the box when it is beside
    the body. Else the side is the one with the largest gap; 'between' means that another body lies
    on the same side of the box.

    Args:
        boxes: solids of the box at each pose of the path.
        standing: solids of each fixed body by name.
        name: name of the body that is passed.
        way: (3,) displacement of the box from start to goal in the world [m].
    """
    length = float(np.linalg.norm(way))
    along = way / length if length > 0.0 else np.array([1.0, 0.0, 0.0])
    level = np.array([along[0], along[1], 0.0])
    if np.linalg.norm(level) > LEVEL:
        left = np.cross([0.0, 0.0, 1.0], level / np.linalg.norm(level))
        up = np.cross(along, left)
        sides = {"left of": left, "right of": -left, "over": up, "under": -up}
    else:
        x, y, _ = np.eye(3)
        sides = {"+x of": x, "-x of": -x, "+y of": y, "-y of": -y}
    body = standing[name]
    middle = _reach(body, along) - _reach(body, -along)
    abreast = min(boxes, key=lambda box: abs(_reach(box, along) - _reach(box, -along) - middle))

    def faces(other: tuple[Piece, ...], side: Array) -> bool:
        """Return True if the box would meet a body if it moved in a given direction.

        Args:
            other: solids of the body.
            side: (3,) direction in the world.
        """
        across = along, np.cross(along, side)
        return any(
            _gap(abreast, (piece,), side) >= 0.0
            and all(
                max(_gap(abreast, (piece,), d), _gap(abreast, (piece,), -d)) < 0.0 for d in across
            )
            for piece in other
        )

    if any(faces(body, side) and faces(body, -side) for side in sides.values()):
        return f"through {name}"
    best = max(sides, key=lambda side: _gap(abreast, body, -sides[side]))
    opposite = [
        other for other in standing if other != name and faces(standing[other], sides[best])
    ]
    if not opposite:
        return f"{best} {name}"
    nearest = min(opposite, key=lambda other: _gap(abreast, standing[other], sides[best]))
    return "between {} and {}".format(*sorted((name, nearest)))


def _gap(box: tuple[Piece, ...], body: tuple[Piece, ...], direction: Array) -> float:
    """Compute how far the box may move along a direction until its extent in this direction reaches
    that of a body [m]; negative if the extents overlap.

    Args:
        box: solids of the box.
        body: solids of the body.
        direction: (3,) unit direction in the world.
    """
    return -_reach(body, -direction) - _reach(box, direction)


def _reach(pieces: tuple[Piece, ...], direction: Array) -> float:
    """Compute the largest coordinate of solids along a direction [m].

    Args:
        pieces: the solids.
        direction: (3,) unit direction in the world.
    """
    return max(float(support(piece, direction)[0]) for piece in pieces)


class PoseJudge:
    """Collision checker of box poses and joint positions, with a clearance margin.

    Attributes:
        geometry: the cell's bodies and the pairs of them that are checked.
        margin: additional clearance, beyond the cell's tolerance, below which bodies count as
            colliding [m].
        checker: collision checker with this clearance.
        met: number of collisions by pair of bodies since this counter was cleared.
    """

    def __init__(self, geometry: CellGeometry, checker: CollisionChecker, margin: float) -> None:
        """Store the attributes. `judge_of` builds a checker from a cell.

        Args:
            geometry: the cell's bodies and the pairs of them that are checked.
            checker: collision checker whose clearance includes the margin.
            margin: additional clearance [m].
        """
        self.geometry = geometry
        self.margin = margin
        self.met: Counter[tuple[str, str]] = Counter()
        self.checker = checker
        # What the other arm moves; not the torso of a machine, which is listed with the first.
        frames = [
            (geometry.bodies[pair.first].frame, geometry.bodies[pair.second].frame)
            for pair in geometry.active
        ]
        robots = [{frame.robot for frame in both} for both in frames]
        self._others = [
            np.array(
                [k for k, met in enumerate(robots) if 1 - arm in met or met == {-1}], dtype=int
            )
            for arm in (0, 1)
        ]

    def with_margin(self, margin: float) -> PoseJudge:
        """Return a checker of the same cell with another `margin` [m]."""
        workcell = self.geometry.workcell
        collision = workcell.collision
        wider = replace(collision, tolerance=collision.tolerance - self.margin + margin)
        geometry = replace(self.geometry, workcell=replace(workcell, collision=wider))
        checker = CollisionChecker(geometry, self.checker.functions)
        return PoseJudge(geometry, checker, margin)

    def colliding(self, pose: Array, q_1: Array, q_2: Array) -> NDArray[np.bool_]:
        """Find configurations of both arms and the box that collide.

        Args:
            pose: (n, 6) box poses [m, rad].
            q_1: (n, joints) joint positions of the first arm [rad or m].
            q_2: (n, joints) joint positions of the second arm [rad or m].

        Returns:
            (n,) True for configurations that collide.
        """
        found = self.checker.check(pose, q_1, q_2)
        if found.first_touch is not None:
            self.met[found.first_touch.first, found.first_touch.second] += 1
        return found.colliding

    def arm_colliding(
        self, arm: int, pose: Array, q: Array, with_box: bool = True
    ) -> NDArray[np.bool_]:
        """Find configurations of one arm and the box that collide. The other arm is left out.

        Args:
            arm: index of the arm.
            pose: (n, 6) box poses [m, rad].
            q: (n, joints) joint positions of the arm [rad or m].
            with_box: False to leave out the box too.

        Returns:
            (n,) True for configurations that collide.
        """
        absent = np.zeros((len(q), self.geometry.arms[1 - arm].joints))
        q_1, q_2 = (q, absent) if arm == 0 else (absent, q)
        bounds = self.checker.bounds(pose, q_1, q_2)
        bounds[:, self._others[arm]] = np.inf
        if not with_box:
            bounds[:, [PAYLOAD_NAME in names for names in self.geometry.pair_names]] = np.inf
        return self.checker.check(pose, q_1, q_2, bounds).colliding

    def payload_colliding(self, pose: Array) -> NDArray[np.bool_]:
        """Find box poses at which the box collides with bodies that are fixed in the world. Moving
        links are left out.

        Args:
            pose: (n, 6) box poses [m, rad].

        Returns:
            (n,) True for poses that collide.
        """
        bodies = self.geometry.bodies
        frames = [{bodies[p.first].frame, bodies[p.second].frame} for p in self.geometry.active]
        standing = [WORLD in both and any(f.kind == "box" for f in both) for both in frames]
        q_1, q_2 = (np.zeros((len(pose), arm.joints)) for arm in self.geometry.arms)
        bounds = np.where(standing, self.checker.bounds(pose, q_1, q_2), np.inf)
        return self.checker.check(pose, q_1, q_2, bounds).colliding

    def resting(self, pose: Array) -> list[tuple[str, bool]]:
        """Find the bodies of the environment that the box touches at a pose.

        Args:
            pose: (6,) pose of the box [m, rad].

        Returns:
            Names of the bodies. Each has True if the box penetrates the body, and False if it only
            rests on it, within a tolerance.
        """
        names = [
            (k, pair) for k, pair in enumerate(self.geometry.pair_names) if PAYLOAD_NAME in pair
        ]
        standing = {body.name for body in self.geometry.workcell.environment}
        q_1, q_2 = (np.zeros((1, arm.joints)) for arm in self.geometry.arms)
        found = []
        for number, pair in names:
            other = next(name for name in pair if name != PAYLOAD_NAME)
            if other not in standing:
                continue
            at, pair_number = np.zeros(1, dtype=np.intp), np.full(1, number)
            if self.checker.collisions(pose[None], q_1, q_2, at, pair_number)[0]:
                found.append((other, self.checker.penetrates(pose, number)))
        return found

    def first_pair(
        self, pose: Array, q_1: Array, q_2: Array, arm: int | None = None
    ) -> tuple[str, str] | None:
        """Return the names of the first pair of bodies that collides in a configuration; None if
        none does.

        Args:
            pose: (6,) box pose [m, rad].
            q_1: (joints,) joint positions of the first arm [rad or m].
            q_2: (joints,) joint positions of the second arm [rad or m].
            arm: index of the only arm that counts; None for both.
        """
        pose, q_1, q_2 = (np.atleast_2d(part) for part in (pose, q_1, q_2))
        bounds = self.checker.bounds(pose, q_1, q_2)
        if arm is not None:
            bounds[:, self._others[arm]] = np.inf
        touch = self.checker.check(pose, q_1, q_2, bounds).first_touch
        return None if touch is None else (touch.first, touch.second)


def judge_of(bodies: CellBodies) -> PoseJudge:
    """Build the collision checker of a cell, without additional clearance.

    Args:
        bodies: arms and bodies of the cell.
    """
    made = bodies.screening
    functions = {name: interpret(made[name]) for name in made if not name.endswith("motion")}
    return PoseJudge(bodies.geometry, CollisionChecker(bodies.geometry, functions), 0.0)


SAME_BRANCH = 0.02
"""Largest difference between a path's first posture and its branch, up to full turns [rad or m]."""

COARSE = 9
"""Stride of the samples that are checked first: most candidates that collide do so at one of
them."""

LOOKED = (1, 3)
"""Number of samples, nearest first, that are checked in the first batch, and until the end of the
second."""

_PLACED = ("pose", "q_1", "q_2")

CHUNK = 32
"""Number of candidates whose samples are held in memory together."""


class Trial:
    """Evaluator of a proposed cell that interprets its functions in place of compiling them.

    Attributes:
        workcell: the cell, with the start branches that were found.
        branches: index of each robot's start branch among its ranked branches.
        bodies: arms and bodies of the cell, which do not depend on the carry.
        model: symbolic model of the cell.
        evaluator: evaluator of candidates.
    """

    def __init__(
        self,
        workcell: Workcell,
        start: tuple[Array, Array],
        bodies: CellBodies | None = None,
        named: bool = True,
    ) -> None:
        """Build the model and the evaluator of the proposed cell, with given postures at the start.

        Args:
            workcell: the proposed cell.
            start: postures (joints,) of both arms at the beginning of the carry [rad or m].
            bodies: arms and bodies of the cell, if known from a trial of another carry; None to
                compute them.
            named: True to find the index of each posture among the arm's start branches; False to
                leave the indices at -1, which is faster.

        Raises:
            BranchLostError: a posture is not among the start branches.
            DualArmError: the cell cannot be modelled.
        """
        workcell = replace(workcell, start_branch=(-1, -1))
        self.bodies = bodies or build_cell_bodies(workcell)
        if named:
            model = build_cell_model(workcell, self.bodies)
            found = [_branch(model.branches[i], start[i]) for i in (0, 1)]
            begin = [np.array(model.branches[i][found[i]].q) for i in (0, 1)]
            workcell = replace(workcell, start_branch=(found[0], found[1]))
            model = replace(model, workcell=workcell, start=(begin[0], begin[1]))
        else:
            known = self.bodies
            model = CellModel(workcell, known.robots, known.geometry, ((), ()), start)
        vars(model)["screening"] = self.bodies.screening  # of the same bodies: not made again
        self.workcell, self.model, self.branches = workcell, model, workcell.start_branch
        interpreted = InterpretedCell(self.workcell, model=model)
        self.evaluator = CandidateEvaluator(self.workcell, compiled=interpreted, threads=0)
        # Forces that a solver finds take most of a candidate's time.
        self._solved = not contact_model(self.workcell).has_closed_form
        self._motion = interpret(motion_function(model)) if self._solved else None

    @property
    def initial(self) -> Array:
        """(n_var,) decision vector of the proposed carry."""
        return initial_decision(self.workcell.task)

    def start_of(self, x: Array) -> tuple[Array, Array]:
        """Compute the posture (joints,) [rad or m] of each arm at the start of a candidate's carry.

        Args:
            x: (n_var,) decision vector.
        """
        outputs = self.evaluator.outputs(x[None])
        return outputs["q_1"][0, 0], outputs["q_2"][0, 0]

    def verdict(self) -> tuple[Judgement, str]:
        """Evaluate the proposed carry at its samples and between them, and check that the contacts
        can hold the box at rest at start and goal.

        Returns:
            The verdict; and the reason if the carry is not feasible, else ''.
        """
        judgement, why = self.verdict_on(self.initial)
        told = (
            static_hold_error(self.workcell, self.evaluator.outputs) if judgement.feasible else ""
        )
        return (
            (replace(judgement, feasible=False, reason="hold"), told) if told else (judgement, why)
        )

    def certain(self, x: Array) -> bool:
        """Return True if the carry of a decision vector is feasible at its samples and between
        them.

        Args:
            x: (n_var,) decision vector.
        """
        return bool(self.feasible(x[None])[0]) and self.verdict_on(x)[0].feasible

    def verdict_on(self, x: Array) -> tuple[Judgement, str]:
        """Evaluate the carry of a decision vector at its samples and between them.

        Args:
            x: (n_var,) decision vector.

        Returns:
            The verdict; and the reason if the carry is not feasible, else ''.
        """
        verdicts = self.evaluator.evaluate(x[None])
        judgement = verdicts.judgement(0, self.evaluator.objective_names)
        if not judgement.feasible:
            return judgement, str(explain(self.evaluator, verdicts)[0])
        try:
            certificate = self.evaluator.certificate(x)
        except LostPathError as error:
            return replace(judgement, feasible=False, reason="reach"), str(error)
        if certificate.is_free:
            return judgement, ""
        place = f"not proven free at {100.0 * certificate.at_parameter:.0f} % of the path"
        return replace(judgement, feasible=False, reason="between_samples"), place

    def feasible(self, x: Array) -> NDArray[np.bool_]:
        """Find decision vectors whose carries are feasible at all samples of the task.

        Args:
            x: (n, n_var) decision vectors.

        Returns:
            (n,) True for feasible ones.
        """
        parts = [self._feasible(x[k : k + CHUNK]) for k in range(0, len(x), CHUNK)]
        return np.concatenate(parts)

    def _feasible(self, x: Array) -> NDArray[np.bool_]:
        outputs = self.evaluator.outputs(x) if self._motion is None else self._motion.batch(x)
        fine = _satisfied(outputs)
        for k in np.flatnonzero(fine).tolist():
            fine[k] = not self._collides([outputs[name][k] for name in _PLACED])
        if self._motion is not None and fine.any():
            fine[fine] = _satisfied(self.evaluator.outputs(x[fine]))
        return fine

    def _collides(self, placed: list[Array]) -> bool:
        """Return True if a carry collides at a sample.

        Args:
            placed: box poses (n, 6) and joint positions (n, joints) of both arms, at n samples.
        """
        last = len(placed[0]) - 1
        coarse = np.arange(last, -1, -COARSE)
        return self._hit(placed, coarse) or self._hit(
            placed, np.setdiff1d(np.arange(last + 1), coarse)
        )

    def _hit(self, placed: list[Array], rows: NDArray[np.intp]) -> bool:
        """Return True if a carry collides at one of the given samples. Samples whose lower bound of
        the clearance is smallest are checked first.

        Args:
            placed: box poses (n, 6) and joint positions (n, joints) of both arms, at n samples.
            rows: indices of the samples.
        """
        checker = self.evaluator.checker
        pose, q_1, q_2 = (np.ascontiguousarray(values[rows]) for values in placed)
        bounds = checker.bounds(pose, q_1, q_2)
        order = np.argsort((bounds - checker.free_beyond).min(axis=1, initial=np.inf))
        return any(
            checker.check(pose[few], q_1[few], q_2[few], bounds[few]).colliding.any()
            for few in np.split(order, LOOKED)
        )


def _satisfied(outputs: dict[str, Array]) -> NDArray[np.bool_]:
    """Find candidates that satisfy all constraints except freedom from collisions.

    Args:
        outputs: outputs of the evaluator's functions for n candidates, by name.

    Returns:
        (n,) True for such candidates.
    """
    finite = np.isfinite(outputs["time"]).all(axis=tuple(range(1, outputs["time"].ndim)))
    return np.asarray(np.all(outputs["violation"] <= 0.0, axis=1) & finite)


class BranchLostError(Exception):
    """A posture is not among the start branches of its arm."""


def _branch(branches: tuple[StartBranch, ...], q: Array) -> int:
    """Return the index of the start branch whose posture equals a given one up to full turns.

    Args:
        branches: start branches of the arm.
        q: (joints,) the posture [rad].

    Raises:
        BranchLostError: no start branch has this posture.
    """
    apart = [
        float(np.abs(np.remainder(branch.q - q + np.pi, 2.0 * np.pi) - np.pi).max())
        for branch in branches
    ]
    best = int(np.argmin(apart)) if apart else 0
    if not apart or apart[best] > SAME_BRANCH:
        raise BranchLostError
    return best


def grasp_blocked(trial: Trial, handling: Handling) -> str:
    """Return a text on what blocks the pads before or after a carry: at their approach, the lift,
    the set-down or their retreat.

    The text is '' if nothing blocks them. It is also '' for other contacts than two opposite round
    pads, which are not checked.

    Args:
        trial: the carry, with its evaluator.
        handling: motions of the pads before and after the carry.
    """
    cell = replace(trial.workcell, handling=handling)
    if not cell.has_facing_pads:
        return ""
    found = trial.evaluator.outputs(trial.initial[None])
    q = np.hstack([found["q_1"][0], found["q_2"][0]])[[0, -1]]
    collisions = JobCollisions(InterpretedCell(cell, model=trial.model))
    posture = trial.evaluator.functions["posture"]
    return describe_obstruction(cell, collisions, posture, found["pose"][0][[0, -1]], q)
