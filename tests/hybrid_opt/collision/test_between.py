"""Between samples: planted obstacles are found, free motion is proven, doubts are told."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from codegen.interpreted import InterpretedFunction
from codegen.source import dense
from hybrid_opt.collision.between import check_between
from hybrid_opt.collision.certify import certify
from hybrid_opt.collision.checker import CollisionChecker
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.geometry.pairs import build_geometry
from symbolic.records import Body, Box
from symbolic.records.poses import pose_matrix
from tests.symbolic.geometry.collision_cells import Configurations, functions_of, rack

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
    functions = {n: InterpretedFunction(dense(f)) for n, f in functions_of(geometry).items()}
    return CollisionChecker(geometry, functions)


def at(x: float) -> Array:
    return pose_matrix([x, 0.0, 1.0], [0.0, 0.0, 0.0])


def passing(xs: Array, roll: float = 0.0) -> Configurations:
    """The box at positions along x, level with the plate, the arms at rest."""
    n = len(xs)
    pose = np.column_stack([xs, np.zeros(n), np.full(n, 1.0), np.full(n, roll), np.zeros((n, 2))])
    return pose, np.tile(BENT, (n, 1)), np.tile(BENT, (n, 1))


def test_a_thin_plate_between_two_samples_is_found() -> None:
    """Samples on both sides of a plate are free; the box passes through it between them."""
    judge = checker(thickness=0.001)
    samples = passing(np.array([-0.6, -0.2, 0.2, 0.6]))
    assert judge.check(*samples, np.arange(4.0)).is_free
    calls = judge.judge.calls
    verdict = check_between(judge, np.hstack(samples))
    assert verdict.status == "collision"
    assert verdict.unsafe.tolist() == [False, True, False]
    touch = verdict.touch
    assert touch is not None
    assert (touch.interval, touch.first, touch.second) == (1, "payload", "plate")
    assert abs(-0.2 + 0.4 * touch.fraction) <= 0.15 + 0.001
    assert verdict.added > 0
    assert judge.judge.calls > calls


def test_the_same_motion_without_the_plate_is_free() -> None:
    verdict = check_between(checker(), np.hstack(passing(np.array([-0.6, -0.2, 0.2, 0.6]))))
    assert (verdict.status, verdict.touch) == ("free", None)
    assert not verdict.unsafe.any()


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
    functions = {n: InterpretedFunction(dense(f)) for n, f in functions_of(geometry).items()}
    blocked = CollisionChecker(geometry, functions)
    pose, _, q_2 = passing(np.array([0.5, 0.5]))
    samples = (pose, np.stack([start, end]), q_2)
    assert blocked.check(*samples, np.arange(2.0)).is_free
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
    verdict = check_between(judge, np.hstack([pose, q_1, q_2]), depth=8)
    assert verdict.status == status
    assert verdict.unsafe.any() == (status == "undecided")
    if status == "undecided":
        assert verdict.touch is not None
        assert verdict.touch.second in ("near wall", "far wall")


def test_colliding_samples_are_not_missed() -> None:
    verdict = check_between(
        checker(thickness=0.001), np.hstack(passing(np.array([-0.6, 0.1, 0.6])))
    )
    assert verdict.status == "collision"
    assert verdict.unsafe.tolist() == [True, True]


def line(u: Array) -> Configurations:
    return passing(1.2 * u - 0.6)


def arc(u: Array) -> Configurations:
    """Around the plate: half a circle about its centre, the box kept level."""
    n = len(u)
    pose, q_1, q_2 = passing(-0.6 * np.cos(np.pi * u))
    pose[:, 2] = 1.0 + 0.6 * np.sin(np.pi * u)
    return pose, q_1, q_2 + 0.1 * np.sin(np.pi * u)[:, None] * np.ones((n, 6))


def test_a_path_through_the_plate_is_refused_with_its_place() -> None:
    certificate = certify(checker(thickness=0.001), line, np.linspace(0.0, 1.0, 4))
    assert not certificate.is_free
    assert certificate.at_sample is None
    assert certificate.motion is not None
    assert certificate.motion.status == "collision"
    assert abs(1.2 * certificate.at_parameter - 0.6) <= 0.151


def test_a_collision_on_the_grid_is_named() -> None:
    certificate = certify(checker(thickness=0.001), line, np.linspace(0.0, 1.0, 5))
    assert not certificate.is_free
    assert certificate.at_sample is not None
    assert certificate.at_sample.second == "plate"
    assert certificate.at_parameter == pytest.approx(0.5)


def test_a_curved_path_around_the_plate_is_certified() -> None:
    certificate = certify(checker(thickness=0.001), arc, np.linspace(0.0, 1.0, 8))
    assert certificate.is_free
    assert np.isnan(certificate.at_parameter)
    assert certificate.deviation <= 1e-4
    assert certificate.grid_points > 8


def test_a_path_that_jumps_is_refused() -> None:
    def jump(u: Array) -> Configurations:
        return passing(np.where(u < 0.337, -0.6, 0.6))

    with pytest.raises(SettingsError, match="jumps"):
        certify(checker(), jump, np.linspace(0.0, 1.0, 5))


def test_a_certified_path_is_free_on_a_fine_grid() -> None:
    """The certificate against brute force: 2000 samples of unscreened FCL."""
    judge = checker(thickness=0.001)
    certificate = certify(judge, arc, np.linspace(0.0, 1.0, 8))
    u = np.linspace(0.0, 1.0, 2000)
    assert certificate.is_free == (not judge.collision_mask(*arc(u)).any())
