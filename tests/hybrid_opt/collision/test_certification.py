"""Certificates: free between samples, against dense sampling; intervals of motion."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from codegen.function import NumericFunction
from codegen.interpreted import InterpretedFunction
from hybrid_opt import metaheuristics
from hybrid_opt.collision.between import MotionVerdict
from hybrid_opt.collision.certify import (
    Certificate,
    LostPathError,
    SampledPath,
    certificates,
    certify,
    configurations,
)
from hybrid_opt.collision.checker import BodyDistances, CollidingPair, CollisionChecker
from hybrid_opt.evaluate.evaluation import BETWEEN_SAMPLES, REASONS, CandidateEvaluator
from hybrid_opt.evaluate.objectives import non_dominated
from hybrid_opt.metaheuristics.run import CarryProblem
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.geometry.pairs import build_geometry
from symbolic.path.spline import extended_waypoints
from symbolic.read.cell import load
from symbolic.records import Body, Box
from symbolic.records.cell import box_flange
from symbolic.records.poses import inverse, pose_matrix
from symbolic.records.task import initial_decision
from symbolic.robot.model import build_robot_model
from tests.hybrid_opt.cells import shipped
from tests.hybrid_opt.collision.test_checker import check_between, collision_mask
from tests.refusals import refused
from tests.symbolic.geometry.collision_cells import Configurations, functions_of, rack
from tests.symbolic.read.samples import RACK


@pytest.fixture(scope="module")
def evaluator() -> CandidateEvaluator:
    return shipped("rack").evaluator


def sampled(evaluator: CandidateEvaluator, x: Array) -> SampledPath:
    outputs = evaluator.outputs(x)
    task = evaluator.workcell.task
    return SampledPath(task, extended_waypoints(task, x), outputs["q_1"][0], outputs["q_2"][0])


def lifted(path: SampledPath) -> SampledPath:
    """A path of which a waypoint is out of reach."""
    away = path.waypoints.copy()
    away[2, 2] += 3.0
    return replace(path, waypoints=away)


def placed(evaluator: CandidateEvaluator, path: SampledPath, u: Array) -> tuple[Array, ...]:
    owner = np.zeros(len(u), dtype=np.intp)
    found = configurations([path], evaluator.functions["posture"], owner, u)
    return evaluator.checker.split(found)


def test_places_between_samples_close_both_arms(evaluator: CandidateEvaluator) -> None:
    workcell = evaluator.workcell
    path = sampled(evaluator, workcell.task.initial.reshape(-1))
    u = np.random.default_rng(1).uniform(0.0, 1.0, 30)
    poses, *joints = placed(evaluator, path, u)
    for robot, contact, q in zip(workcell.robots, workcell.contacts, joints, strict=True):
        model = build_robot_model(robot)
        data = model.model.createData()
        for pose, posture in zip(poses, q, strict=True):
            pin.framesForwardKinematics(model.model, data, posture)
            reached = data.oMf[model.flange_id].homogeneous
            wanted = inverse(robot.T_world_base) @ pose_matrix(pose[:3], pose[3:])
            np.testing.assert_allclose(reached, wanted @ box_flange(robot, contact), atol=2e-6)


def test_samples_are_places_on_the_path(evaluator: CandidateEvaluator) -> None:
    task = evaluator.workcell.task
    x = task.initial.reshape(-1)
    path = sampled(evaluator, x)
    samples = np.linspace(0.0, 1.0, task.samples)
    poses, q_1, q_2 = placed(evaluator, path, samples)
    np.testing.assert_allclose(poses, evaluator.outputs(x)["pose"][0], atol=1e-12)
    np.testing.assert_allclose(q_1, path.q_1, atol=1e-5)
    np.testing.assert_allclose(q_2, path.q_2, atol=1e-5)


def test_a_path_that_an_arm_cannot_follow_is_told(evaluator: CandidateEvaluator) -> None:
    broken = lifted(sampled(evaluator, evaluator.workcell.task.initial.reshape(-1)))
    _, *joints = placed(evaluator, broken, np.array([0.0, 0.5]))
    assert all(np.isfinite(q[0]).all() and np.isnan(q[1]).all() for q in joints)
    (verdict,) = certificates(evaluator.checker, evaluator.functions["posture"], [broken])
    assert verdict.lost
    assert not verdict.is_free
    assert 0.0 < verdict.at_parameter < 1.0
    lost = np.array(evaluator.workcell.task.initial)
    lost[0, 2] += 3.0
    with pytest.raises(LostPathError):
        evaluator.certificate(lost.reshape(-1))


def test_certificates_are_the_same_together_and_alone(evaluator: CandidateEvaluator) -> None:
    """To the bit: free ones, colliding ones and one that an arm does not follow, in one call."""
    rng = np.random.default_rng(5)
    spread = 0.1 * (evaluator.upper - evaluator.lower)
    x = evaluator.workcell.task.initial.reshape(-1) + spread * rng.uniform(
        -1.0, 1.0, (60, evaluator.n_var)
    )
    x = x[evaluator.evaluate(x).reason != REASONS.index("reach_1")]
    paths = [sampled(evaluator, one) for one in x]
    paths[3] = lifted(paths[3])
    posture = evaluator.functions["posture"]
    together = certificates(evaluator.checker, posture, paths)
    alone = [certificates(evaluator.checker, posture, [path])[0] for path in paths]
    assert {(c.is_free, c.lost, c.at_sample is None) for c in together} >= {
        (True, False, True),
        (False, False, False),
        (False, True, True),
    }
    for a, b in zip(together, alone, strict=True):
        for name in ("is_free", "lost", "at_sample", "grid_points"):
            assert getattr(a, name) == getattr(b, name)
        np.testing.assert_array_equal([a.at_parameter, a.deviation], [b.at_parameter, b.deviation])
        assert a.motion == b.motion


def test_what_no_proof_can_show_is_given_up_early(
    evaluator: CandidateEvaluator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same paths are proven free and the others fail at the same places, with fewer queries."""
    rng, queries = np.random.default_rng(8), list[int]()
    bounds = BodyDistances.bounds

    def counting(self: BodyDistances, *query: Any) -> tuple[Array, Array]:
        queries.append(len(query[1]))
        return bounds(self, *query)

    monkeypatch.setattr(BodyDistances, "bounds", counting)
    spread = 0.05 * (evaluator.upper - evaluator.lower)
    x = evaluator.workcell.task.initial.reshape(-1) + spread * rng.uniform(
        -1.0, 1.0, (400, evaluator.n_var)
    )
    # Lowered, the box passes boards so closely that nothing can be proven.
    heights = evaluator.workcell.task.free_entries[1] == 2
    x[:, heights] -= np.linspace(0.0, 0.03, len(x))[:, None]
    x = x[evaluator.evaluate(x).feasible][-30:]
    early = [evaluator.certificate(one) for one in x]
    fewer = sum(queries)
    monkeypatch.setattr("hybrid_opt.collision.between.HOPELESS_DEPTH", 99)
    late = [evaluator.certificate(one) for one in x]
    assert [one.is_free for one in early] == [one.is_free for one in late]
    failed = [pair for pair in zip(early, late, strict=True) if not pair[0].is_free]
    assert 3 <= len(failed) < len(x) / 2
    step = 1.0 / (evaluator.workcell.task.samples - 1)
    assert all(abs(a.at_parameter - b.at_parameter) <= step for a, b in failed)
    assert fewer < 0.5 * (sum(queries) - fewer)


def test_every_member_of_a_certified_front_is_proven_free(evaluator: CandidateEvaluator) -> None:
    problem = CarryProblem(evaluator, "penalty")
    metaheuristics.search(problem, metaheuristics.make("nsga2"), 600, np.random.default_rng(1))
    before = problem.evaluations
    after = evaluator.certified(before)
    front = np.flatnonzero(non_dominated(after.objectives, after.feasible))
    assert all(evaluator.certificate(x).is_free for x in after.x[front])

    rejected = np.flatnonzero(after.reason == REASONS.index(BETWEEN_SAMPLES))
    np.testing.assert_array_equal(np.flatnonzero(before.feasible & ~after.feasible), rejected)
    assert not any(evaluator.certificate(x).is_free for x in after.x[rejected])
    # What the search saw stays; a second pass changes nothing.
    np.testing.assert_array_equal(after.penalised, before.penalised)
    np.testing.assert_array_equal(evaluator.certified(after).feasible, after.feasible)


def test_carries_that_share_a_path_are_certified_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Under the drivable law only force limits tell them apart."""
    task = replace(load(RACK).task, time_law="optimal")
    cell = replace(load(RACK), task=task)
    evaluator = CandidateEvaluator(cell, ("duration", "peak_force"))
    touching = np.array(task.initial).reshape(-1)
    touching[: task.n_path] += np.random.default_rng(3).normal(0.0, 1e-3, task.n_path)
    x = np.repeat([initial_decision(task), np.append(touching, 60.0)], 3, axis=0)
    x[:, -1] = np.tile([54.0, 57.0, 60.0], 2)
    certified = list[SampledPath]()

    def counting(
        checker: CollisionChecker, posture: NumericFunction, paths: Sequence[SampledPath]
    ) -> list[Certificate]:
        certified.extend(paths)
        verdicts = certificates(checker, posture, paths)
        moved = np.array([path.waypoints for path in paths]) != extended_waypoints(task, x[0])
        return [
            replace(verdict, is_free=False, at_parameter=0.25) if other.any() else verdict
            for verdict, other in zip(verdicts, moved, strict=True)
        ]

    monkeypatch.setattr("hybrid_opt.evaluate.evaluation.certificates", counting)
    found = [evaluator.certified(evaluator.evaluate(one)) for one in x]
    assert [bool(one.feasible[0]) for one in found] == [True] * 3 + [False] * 3
    assert all(one.position[0] == 0.25 for one in found[3:])
    assert len(certified) == 2


def test_a_certificate_says_what_speaks_against_the_path() -> None:
    touch = CollidingPair(3, "payload", "shelf", 0.5)
    assert re.search("payload .*shelf", Certificate(False, touch, 0.3, None, 10, 0.0).problem)
    assert Certificate(False, None, 0.3, None, 10, 0.0, lost=True).problem
    assert Certificate(True, None, np.nan, None, 10, 0.0).problem == ""
    for status, told in (("collision", "payload .*shelf"), ("undecided", "prove")):
        motion = MotionVerdict(status, touch)  # type: ignore[arg-type]
        found = Certificate(False, None, 0.35, motion, 10, 0.0)
        assert re.search(told, found.problem)
        assert found.problem in repr(found)


BENT = np.array([0.4, -0.3, 0.5, 0.2, -0.4, 0.1])
"""A posture of either arm, away from everything else in the cells below."""


@cache
def checker(thickness: float = 0.0, gap: float = 0.0) -> CollisionChecker:
    """Two arms and a box, far above the floor, with a plate x = 0 of some thickness or a slit."""
    plates: list[Body] = []
    if thickness > 0.0:
        plates.append(Body("plate", Box(np.array([thickness, 0.3, 0.3])), at(0.0)))
    if gap > 0.0:
        offset = 0.15 + gap + 0.05
        plates.append(Body("near wall", Box(np.array([0.1, 0.3, 0.3])), at(-offset)))
        plates.append(Body("far wall", Box(np.array([0.1, 0.3, 0.3])), at(offset)))
    geometry = build_geometry(replace(rack(), environment=tuple(plates)))
    functions = {n: InterpretedFunction(f) for n, f in functions_of(geometry).items()}
    return CollisionChecker(geometry, functions)


def at(x: float) -> Array:
    return pose_matrix([x, 0.0, 1.0], [0.0, 0.0, 0.0])


def passing(xs: Array, roll: float = 0.0) -> Configurations:
    """The box at positions along x, level with the plate, the arms at rest."""
    n = len(xs)
    pose = np.column_stack([xs, np.zeros(n), np.full(n, 1.0), np.full(n, roll), np.zeros((n, 2))])
    return pose, np.tile(BENT, (n, 1)), np.tile(BENT, (n, 1))


def test_a_link_that_sweeps_through_a_plate_is_found() -> None:
    """The forearm swings by a large joint step; only the space between is blocked."""
    start, end = BENT.copy(), BENT.copy()
    start[0], end[0] = -0.6, 0.6
    judge = checker()
    middle = (start + end) / 2.0
    flange = judge.geometry.index("left/link_5")
    pose, _, still = passing(np.array([0.5]))
    poses = judge.functions["piece_poses"].batch(pose, middle[None], still)
    first = sum(len(body.pieces) for body in judge.geometry.bodies[:flange])
    centre = poses["positions"][0, first]
    T = pose_matrix(centre, [0.0, 0.0, 0.0])
    plate = Body("plate", Box(np.array([0.002, 0.002, 0.02])), T)
    geometry = build_geometry(replace(rack(), environment=(plate,)))
    functions = {n: InterpretedFunction(f) for n, f in functions_of(geometry).items()}
    blocked = CollisionChecker(geometry, functions)
    pose, _, q_2 = passing(np.array([0.5, 0.5]))
    samples = (pose, np.stack([start, end]), q_2)
    assert blocked.check(*samples).is_free
    verdict = check_between(blocked, np.hstack(samples))
    assert verdict.status == "collision"
    assert verdict.touch is not None
    assert verdict.touch.second == "plate"
    assert verdict.touch.first.startswith("left/")


@pytest.mark.parametrize(("gap", "status"), [(0.002, "free"), (2e-6, "undecided")])
def test_a_slit_is_passed_if_the_clearance_can_be_told(gap: float, status: str) -> None:
    """The box slides along a slit wider than itself by the gap on either side."""
    judge = checker(gap=gap)
    pose, q_1, q_2 = passing(np.zeros(3))
    pose[:, 1] = [-0.05, 0.0, 0.05]
    verdict = check_between(judge, np.hstack([pose, q_1, q_2]))
    assert verdict.status == status
    if status == "undecided":
        assert verdict.touch is not None
        assert verdict.touch.second in ("near wall", "far wall")


def line(u: Array) -> Configurations:
    return passing(1.2 * u - 0.6)


def arc(u: Array) -> Configurations:
    """Around the plate: half a circle about its centre, the box kept level."""
    n = len(u)
    pose, q_1, q_2 = passing(-0.6 * np.cos(np.pi * u))
    pose[:, 2] = 1.0 + 0.6 * np.sin(np.pi * u)
    return pose, q_1, q_2 + 0.1 * np.sin(np.pi * u)[:, None] * np.ones((n, 6))


def test_a_path_through_a_thin_plate_is_refused_with_its_place() -> None:
    """Samples on both sides of the plate are free; the box passes through it between them."""
    grid = np.linspace(0.0, 1.0, 4)
    certificate = certify(checker(thickness=0.001), line, grid)
    assert not certificate.is_free
    assert certificate.at_sample is None
    assert certificate.motion is not None
    touch = certificate.motion.touch
    assert touch is not None
    assert certificate.motion.status == "collision"
    assert (touch.first, touch.second) == ("payload", "plate")
    assert abs(1.2 * certificate.at_parameter - 0.6) <= 0.151
    assert certify(checker(), line, grid).is_free


def test_a_collision_on_the_grid_is_named() -> None:
    certificate = certify(checker(thickness=0.001), line, np.linspace(0.0, 1.0, 5))
    assert not certificate.is_free
    assert certificate.at_sample is not None
    assert certificate.at_sample.second == "plate"
    assert certificate.at_parameter == pytest.approx(0.5)


def test_a_curved_path_around_the_plate_is_certified() -> None:
    """Against brute force: 2000 samples of unscreened FCL."""
    judge = checker(thickness=0.001)
    certificate = certify(judge, arc, np.linspace(0.0, 1.0, 8))
    assert certificate.is_free
    assert np.isnan(certificate.at_parameter)
    assert certificate.deviation <= 1e-4
    assert certificate.grid_points > 8
    assert not collision_mask(judge, *arc(np.linspace(0.0, 1.0, 2000))).any()


def test_no_pair_is_measured_twice_at_a_place(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where two intervals meet, and at places that stay between shorter ones."""
    judge, measure, seen = checker(gap=2e-6), CollisionChecker.measure, list[tuple[bytes, int]]()

    def noted(self: CollisionChecker, *given: Any) -> Any:
        *configuration, _, wanted = given
        places = np.hstack(configuration)
        seen.extend((places[row].tobytes(), int(pair)) for row, pair in np.argwhere(wanted))
        return measure(self, *given)

    monkeypatch.setattr(CollisionChecker, "measure", noted)
    pose, q_1, q_2 = passing(np.zeros(5))
    pose[:, 1] = np.linspace(-0.05, 0.05, 5)
    check_between(judge, np.hstack([pose, q_1, q_2]))
    assert len(seen) > 10
    assert len(set(seen)) == len(seen)


def test_a_path_that_jumps_is_refused() -> None:
    def jump(u: Array) -> Configurations:
        return passing(np.where(u < 0.337, -0.6, 0.6))

    with refused(SettingsError, "jumps"):
        certify(checker(), jump, np.linspace(0.0, 1.0, 5))
