"""Pads that press evenly: the closed form of two, and the program of pads anywhere."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hybrid_opt.robust.cases import nominal_case
from symbolic.array import Array
from symbolic.contact.even_patch import EvenPatch
from symbolic.contact.force_closure import scaled_patch
from symbolic.contact.soft_finger import SoftPatch, least_soft_squeeze, torsion_capacity
from symbolic.contact.worst_cases import case_squeeze_function
from symbolic.records import Contact, Workcell
from tests.symbolic.cells import hand_cell, with_contacts, with_task
from tests.symbolic.contact.oracle import (
    area_of,
    effort,
    function_of,
    least_on_grids,
    points_of,
    random_grasp,
    random_load,
    wrenches,
)

KINDS = (
    pytest.param(("round", "round"), marks=pytest.mark.slow),
    ("round", "rectangle"),
    ("round", "round", "round"),
    pytest.param(("rectangle",) * 4, marks=pytest.mark.slow),
)


def even_cell() -> Workcell:
    return with_task(hand_cell(), allocation="soft-finger")


# --- pads anywhere ---


@pytest.mark.parametrize("kinds", KINDS)
def test_the_least_effort_is_that_of_grids_of_points(kinds: tuple[str, ...]) -> None:
    """Within what (1) of `soft_finger` is from the exact limit surface: rectangles of up to 12 to 1
    are among them."""
    rng = np.random.default_rng(4)
    cell = random_grasp(rng, even_cell(), kinds)
    function = function_of(cell)
    for _ in range(2):
        load = random_load(rng)
        found, expected = wrenches(cell, load, function), least_on_grids(cell.pads, load)
        ratio = np.sqrt(effort(found) / effort(expected))
        least, most = (0.985, 1.04) if "rectangle" in kinds else (0.99, 1.01)
        assert least < ratio < most, ratio


@pytest.mark.parametrize("alike", [True, False])
def test_pads_of_a_fork_press_with_one_pressure(alike: bool) -> None:
    """Side by side on one arm; with the load nearer to one of them the other could press less, and
    does where their normals differ."""
    rng = np.random.default_rng(5)
    first, second = even_cell().contacts
    T = first.T_box_pad.copy()
    T[:3, 3] += T[:3, :3] @ [0.0, 0.08, 0.0]
    if not alike:
        T[:3, :3] = T[:3, :3] @ Rotation.from_euler("x", 0.02).as_matrix()
    pads = (replace(first, patch_radius=0.03), replace(first, T_box_pad=T, patch_radius=0.02))
    cell = replace(even_cell(), contacts=(replace(pads[0], further=(pads[1],)), second))
    function = function_of(cell)
    for _ in range(3):
        load = random_load(rng) * [1, 1, 1, 0.3, 0.3, 0.3]
        found = wrenches(cell, load, function)
        pressures = found[:2, 2] / [area_of(pad) for pad in pads]
        assert (abs(pressures[0] / pressures[1] - 1.0) < 1e-9) == alike
        expected = least_on_grids(cell.pads, load, fork=alike)
        assert 0.985 < np.sqrt(effort(found) / effort(expected)) < 1.01


def test_two_opposite_pads_press_as_in_closed_form() -> None:
    """Also unequal ones of different shapes, with the load off the line between them."""
    rng = np.random.default_rng(8)
    first, second = even_cell().contacts
    pads = (
        replace(first, friction=0.7, patch_radius=0.03),
        replace(second, friction=0.9, patch_radius=0.05, half_sides=(0.04, 0.03)),
    )
    cell = replace(even_cell(), contacts=pads)
    function, axes = function_of(cell), first.T_box_pad[:3, :3]
    arms = [ca.DM(axes.T @ pad.T_box_pad[:3, 3]) for pad in pads]
    patches = [SoftPatch.of(pad, axes) for pad in pads]
    for _ in range(8):
        load = random_load(rng) * [1, 1, 1, 0.3, 0.3, 0.3]
        force, moment = (ca.SX(ca.DM(axes.T @ part)) for part in (load[:3], load[3:]))
        found = least_soft_squeeze(
            force, moment, (arms[0], arms[1]), ca.SX([0.7, 0.9]), (patches[0], patches[1])
        )
        expected = np.array(ca.evalf(found.normal)).ravel()
        np.testing.assert_allclose(wrenches(cell, load, function)[:, 2], expected, rtol=1e-5)


def test_a_block_on_a_wedge_of_pads_is_held_as_statics_say() -> None:
    """Two pads whose normals stand at 90 degrees below a block need no friction: each bears its
    share of the weight over the root of two. Lifted instead, by pads on adjacent faces, each
    tangential force is at most friction times the normal one."""
    z = 2**-0.5
    places = ((-0.1, 0.0, -0.1), (0.1, 0.0, -0.1), (0.0, 0.0, 0.1))
    normals = ((z, 0.0, z), (-z, 0.0, z), (0.0, 0.0, -1.0))
    pads = []
    for place, normal in zip(places, normals, strict=True):
        T = np.eye(4)
        across = np.array([0.0, 1.0, 0.0])
        T[:3, :3] = np.column_stack([across, np.cross(normal, across), normal])
        T[:3, 3] = place
        pads.append(Contact(T, 0.5, 0.02))
    cell = replace(even_cell(), contacts=(replace(pads[0], further=(pads[1],)), pads[2]))
    found = wrenches(cell, np.array([0.0, 0.0, 80.0, 0.0, 0.0, 0.0]))
    # The least sum of squares lets friction help: no pad on top, both forces upright at 26.6
    # degrees from their normals at most.
    share = 40.0 * np.cos(np.arctan(0.5)) / np.cos(np.pi / 4 - np.arctan(0.5))
    np.testing.assert_allclose(found[:2, 2], share, rtol=1e-4)
    assert found[2, 2] < 1e-3


@pytest.mark.parametrize("kind", ["round", "rectangle"])
def test_a_step_that_counts_as_allowed_stays_within_the_cone(kind: str) -> None:
    rng = np.random.default_rng(3)
    pad = random_grasp(rng, even_cell(), (kind, kind)).pads[0]
    patch = EvenPatch(scaled_patch(pad))
    state, change = ca.SX.sym("s", 4), ca.SX.sym("d", 4)
    look = ca.Function("l", [state, change], [patch.slack(state), patch.lowest(state, change)])
    least = []
    for _ in range(200):
        at = np.array([1.0, *0.6 * rng.uniform(-1, 1, 2), 0.3 * rng.uniform(-1, 1)])
        d = rng.normal(size=4)
        inside, lowest = (float(value) for value in look(at, d))
        if inside <= 0.0:
            continue
        length = min(-1.0 / lowest, 1e3)
        assert float(look(at + (1.0 - 1e-9) * length * d, d)[0]) >= -1e-9
        least.append(float(look(at + 1.05 * length * d, d)[0]))
    # A bound, not the root: most steps that are a little longer leave the cone.
    assert np.mean(np.array(least) <= 0.0) > 0.8


# --- two soft fingers ---


def sliding(contact: Contact, way: float) -> Array:
    """(n, 3) tangential force and torsion of a patch that slides about centres of rotation beside
    its middle, for unit normal force and friction: its exact limit curve, by quadrature.

    Args:
        way: angle of the tangential force from the pad's x axis [rad].
    """
    points, weight = points_of(contact, 200, 160 if contact.half_sides else 256)
    found = []
    size = np.linalg.norm(points, axis=1).max()
    for distance in [0.0, *np.geomspace(0.03, 30.0, 40)]:
        centre = distance * size * np.array([-np.sin(way), np.cos(way)])
        arm = points - centre
        moved = np.column_stack([-arm[:, 1], arm[:, 0]])
        moved /= np.linalg.norm(moved, axis=1)[:, None] + 1e-15
        torsion = weight @ (points[:, 0] * moved[:, 1] - points[:, 1] * moved[:, 0])
        found.append([*(weight @ moved), torsion])
    return np.array(found)


def asked_for(contact: Contact, wrench: Array) -> float:
    """Normal force that (1) asks for with unit friction, by bisection."""
    patch = SoftPatch.of(contact, contact.T_box_pad[:3, :3])
    grip = ca.SX.sym("grip")
    capacity = ca.Function("c", [grip], [torsion_capacity(grip, ca.SX(wrench[:2]), patch)[0]])
    low, high = 0.0, 10.0
    for _ in range(60):
        middle = (low + high) / 2.0
        enough = float(capacity(middle)) >= abs(wrench[2])
        low, high = (low, middle) if enough else (middle, high)
    return float(np.hypot(high, np.linalg.norm(wrench[:2])))


@pytest.mark.parametrize(
    ("half_sides", "least", "most"),
    [(None, -0.004, 0.0035), ((0.03, 0.03), -0.008, 0.005), ((0.04, 0.02), -0.004, 0.03)],
)
def test_forces_are_those_of_the_exact_limit_curve(
    half_sides: tuple[float, float] | None, least: float, most: float
) -> None:
    contact = replace(even_cell().contacts[0], half_sides=half_sides)
    errors = [
        asked_for(contact, wrench) - 1.0
        for way in (0.0, 0.5, 1.1, np.pi / 2)
        for wrench in sliding(contact, way)
    ]
    assert least < min(errors) <= max(errors) < most


def test_level_and_still_it_is_the_paper_s_force() -> None:
    for friction in (0.3, 1.0):
        cell = with_contacts(even_cell(), friction=(friction, friction))
        found = case_squeeze_function(cell)(*[np.zeros(6)] * 3, nominal_case(cell))
        np.testing.assert_allclose(np.array(found).ravel(), 98.1 / (2.0 * friction), rtol=1e-9)


COEFFICIENT = st.floats(0.3, 1.2)
PART = st.floats(-1.0, 1.0)


@given(
    friction=st.tuples(COEFFICIENT, COEFFICIENT),
    radii=st.tuples(st.floats(0.015, 0.05), st.floats(0.015, 0.05)),
    force=st.tuples(PART, PART, PART),
    moment=st.tuples(PART, PART, PART),
    beside=st.tuples(st.floats(-0.01, 0.01), st.floats(-0.01, 0.01)),
)
def test_it_is_the_least_force_that_holds(
    friction: tuple[float, float],
    radii: tuple[float, float],
    force: tuple[float, float, float],
    moment: tuple[float, float, float],
    beside: tuple[float, float],
) -> None:
    """Against bisection: at every squeeze the balance of both pads is solved as a linear system."""
    load = np.array([60.0, 60.0, 30.0]) * force, np.array([2.0, 2.0, 1.0]) * moment
    arms = np.array([[*beside, -0.2], [0.0, 0.05, 0.2]])
    patches = [SoftPatch(2.0 / 3.0 * r, r * np.eye(2)) for r in radii]
    held = least_soft_squeeze(
        ca.SX(load[0]),
        ca.SX(load[1]),
        (ca.SX(arms[0]), ca.SX(arms[1])),
        ca.SX(ca.DM(friction)),
        (patches[0], patches[1]),
        offset=True,
    )
    found = np.asarray(ca.evalf(held.normal)).ravel()

    grip = ca.SX.sym("grip")
    tangent = ca.SX.sym("tangent", 2)
    capacity = [
        ca.Function("c", [grip, tangent], [torsion_capacity(grip, tangent, patch)[0]])
        for patch in patches
    ]

    def holds(n_2: float) -> bool:
        normal = np.array([n_2 + load[0][2], n_2])
        if normal.min() < 0.0:
            return False
        matrix, right = np.zeros((6, 6)), np.concatenate(load)
        for i, sign in enumerate((1.0, -1.0)):
            for k, axis in enumerate(np.eye(3)[:2]):
                matrix[:, 2 * i + k] = np.concatenate([axis, np.cross(arms[i], axis)])
            pressed = sign * normal[i] * np.array([0.0, 0.0, 1.0])
            right = right - np.concatenate([pressed, np.cross(arms[i], pressed)])
        matrix[5, 4] = 1.0
        matrix[2, 5] = 1.0
        solved = np.linalg.solve(matrix, right)
        left = (np.array(friction) * normal) ** 2 - np.sum(solved[:4].reshape(2, 2) ** 2, axis=1)
        if left.min() < 0.0:
            return False
        carried = [float(capacity[i](np.sqrt(left[i]), solved[2 * i : 2 * i + 2])) for i in (0, 1)]
        return bool(sum(carried) >= abs(solved[4]))

    low, high = 0.0, 1e4
    if not holds(high):
        return  # pads so far beside one another that pressing harder does not help
    for _ in range(60):
        middle = (low + high) / 2.0
        low, high = (low, middle) if holds(middle) else (middle, high)
    np.testing.assert_allclose(found, [high + load[0][2], high], rtol=1e-5, atol=1e-3)
