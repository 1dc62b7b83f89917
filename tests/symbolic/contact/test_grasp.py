"""Forces on the central path against Clarabel, by their laws, and their derivatives."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import casadi as ca
import clarabel
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import sparse
from scipy.spatial.transform import Rotation

from hybrid_opt.robust.cases import nominal_case
from symbolic.array import Array
from symbolic.contact.central_path import START_WEIGHT
from symbolic.contact.force_closure import has_force_closure, state_to_box
from symbolic.contact.grasp import REST_WEIGHT, Grasp
from symbolic.contact.grasp_numbers import smaller_patches
from symbolic.contact.paper import normal_force_branches
from symbolic.contact.soft_finger import (
    SoftPatch,
    least_soft_squeeze,
    torsion_capacity,
)
from symbolic.contact.soft_grasp import SoftGrasp
from symbolic.contact.worst_cases import (
    OTHER_WEIGHT,
    GraspSqueeze,
    case_squeeze_function,
    commanded_forces,
    commanded_slack,
)
from symbolic.errors import SettingsError
from symbolic.records import Contact, Workcell
from tests.symbolic.cells import hand_cell, with_contacts, with_task
from tests.symbolic.contact.grasp_oracle import (
    effort,
    friction_of,
    function_of,
    in_box,
    least_wrenches,
    random_grasp,
    random_load,
    turned,
    wrenches,
)

KINDS = (
    ("round", "round"),
    ("round", "rectangle"),
    ("rectangle", "rectangle"),
    ("round", "round", "round"),
    ("rectangle", "round", "rectangle"),
    ("rectangle",) * 4,
)


@pytest.mark.parametrize("grasps", [3, pytest.param(60, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kinds", KINDS)
def test_agrees_with_clarabel(kinds: tuple[str, ...], grasps: int) -> None:
    rng = np.random.default_rng(1)
    for _ in range(grasps):
        cell = random_grasp(rng, hand_cell(), kinds)
        function = function_of(cell)
        for _ in range(6):
            load = random_load(rng)
            found, expected = wrenches(cell, load, function), least_wrenches(cell.pads, load)
            assert effort(found) == pytest.approx(effort(expected), rel=1e-6)
            size = np.sqrt(effort(found))
            np.testing.assert_allclose(found[:, :3] / size, expected[:, :3] / size, atol=2e-3)
            balance = sum(in_box(p) @ w for p, w in zip(cell.pads, found, strict=True))
            np.testing.assert_allclose(balance, load, atol=1e-9 * size)


@pytest.mark.parametrize("seed", range(6))
def test_a_rectangle_needs_no_less_than_carons_cone_and_no_more_than_the_one_within(
    seed: int,
) -> None:
    """Its friction pyramids hold the circular cones, those of friction over sqrt(2) lie within."""
    rng = np.random.default_rng(seed)
    cell = random_grasp(rng, hand_cell(), ("rectangle", "rectangle"))
    load = random_load(rng)
    least, ours, most = (
        caron_effort(cell.pads, load, 1.0),
        effort(wrenches(cell, load)),
        caron_effort(cell.pads, load, 0.5**0.5),
    )
    assert least * (1.0 - 1e-6) <= ours <= most * (1.0 + 1e-6)


def caron_effort(pads: tuple[Contact, ...], load: Array, share: float) -> float:
    """Least effort by clarabel with Caron's inequalities; infinite where there is none."""
    rows = []
    for i, pad in enumerate(pads):
        own = np.zeros((16, 6 * len(pads)))
        own[:, 6 * i : 6 * i + 6] = caron_rows(pad, share * pad.friction)
        rows.append(own)
    squares = sparse.diags(np.tile([1.0, 1, 1, 0, 0, 0], len(pads)))
    options = clarabel.DefaultSettings()
    options.verbose = False
    options.tol_gap_abs = options.tol_gap_rel = options.tol_feas = 1e-10
    size = float(np.linalg.norm(load))
    solution = clarabel.DefaultSolver(
        sparse.csc_matrix(squares),
        np.zeros(6 * len(pads)),
        sparse.csc_matrix(np.vstack([np.hstack([in_box(pad) for pad in pads]), *rows])),
        np.concatenate([load / size, np.zeros(16 * len(pads))]),
        [clarabel.ZeroConeT(6), clarabel.NonnegativeConeT(16 * len(pads))],
        options,
    ).solve()
    if str(solution.status) == "PrimalInfeasible":
        return float("inf")
    assert str(solution.status) in ("Solved", "AlmostSolved"), solution.status
    return size**2 * effort(np.array(solution.x).reshape(-1, 6))


def caron_rows(pad: Contact, mu: float) -> Array:
    """(16, 6) rows that are at most zero within the cone of Caron et al. (ICRA 2015, Prop. 2)."""
    assert pad.half_sides is not None
    x, y = pad.half_sides
    f_x, f_y, f_z, m_x, m_y, m_z = np.eye(6)
    rows = [sign * f - mu * f_z for f in (f_x, f_y) for sign in (1, -1)]
    rows += [sign * m_x - y * f_z for sign in (1, -1)]
    rows += [sign * m_y - x * f_z for sign in (1, -1)]
    for one in (1, -1):
        for two in (1, -1):
            low = one * (y * f_x - mu * m_x) + two * (x * f_y - mu * m_y)
            high = one * (y * f_x + mu * m_x) + two * (x * f_y + mu * m_y)
            rows += [-m_z - mu * (x + y) * f_z + low, m_z - mu * (x + y) * f_z + high]
    return np.array(rows)


@pytest.mark.parametrize(
    ("allocation", "most"), [("paper", 5), ("soft-finger", 4)], ids=["points", "even pads"]
)
@given(seed=st.integers(0, 2**31), chosen=st.integers(0, 4))
@settings(max_examples=4)
def test_turning_all_turns_the_forces(allocation: str, most: int, seed: int, chosen: int) -> None:
    rng, kinds = np.random.default_rng(seed), KINDS[chosen % most]
    base = with_task(hand_cell(), allocation=allocation)
    cell, load = random_grasp(rng, base, kinds), random_load(rng)
    rotation = Rotation.random(random_state=seed)
    first, last = cell.contacts
    moved = replace(
        turned(first, rotation), further=tuple(turned(p, rotation) for p in first.further)
    )
    other = replace(cell, contacts=(moved, turned(last, rotation)))
    there = wrenches(other, np.concatenate([rotation.apply(load[:3]), rotation.apply(load[3:])]))
    here = wrenches(cell, load)
    size = np.sqrt(effort(here))
    np.testing.assert_allclose(there[:, :3], here[:, :3], atol=1e-4 * size)


@given(seed=st.integers(0, 2**31), kinds=st.sampled_from(KINDS[:5]))
@settings(max_examples=5)
def test_derivatives_are_those_of_the_forces(seed: int, kinds: tuple[str, ...]) -> None:
    rng = np.random.default_rng(seed)
    cell, load = random_grasp(rng, hand_cell(), kinds), random_load(rng)
    function, friction = function_of(cell, differentiable=True), friction_of(cell)
    symbol = ca.MX.sym("load", 6)
    normal = function(symbol, friction)[0]
    derivative = ca.Function("derivative", [symbol], [ca.jacobian(normal, symbol)])
    jacobian: Array = np.array(derivative(load)).ravel()
    scale = max(1.0, float(np.abs(jacobian).max()))
    for k, step in enumerate(1e-4 * np.eye(6)):
        ends = [float(function(load + sign * step, friction)[0]) for sign in (1.0, -1.0)]
        assert (ends[0] - ends[1]) / 2e-4 == pytest.approx(jacobian[k], abs=1e-3 * scale)


def pad(
    place: tuple[float, float, float], normal: tuple[float, float, float], mu: float
) -> Contact:
    """A pad of 1 mm radius."""
    z = np.array(normal) / np.linalg.norm(normal)
    x = np.cross(z, [0.3, 0.5, 0.8])
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.column_stack([x, np.cross(z, x), z]), place
    return Contact(T, mu, 1e-3)


@pytest.mark.parametrize(("mu", "closes"), [(1.02, False), (1.1, True)])
def test_adjacent_faces_hold_where_both_cones_reach_across_the_edge(
    mu: float, closes: bool
) -> None:
    """The line between points as far from the edge lies at 45 degrees to both faces: friction
    above one, with five percent to spare."""
    contacts = (pad((0.1, 0.0, 0.0), (-1, 0, 0), mu), pad((0.0, 0.1, 0.0), (0, -1, 0), mu))
    cell = replace(hand_cell(), contacts=contacts)
    if not closes:
        with pytest.raises(SettingsError, match="do not close their grasp"):
            Grasp(cell)
        return
    # A force along the bisector: its halves act at the pads, at 45 degrees to both normals.
    found = wrenches(cell, np.array([-10.0, -10.0, 0.0, 0.0, 0.0, 0.0]))
    np.testing.assert_allclose(found[:, 2], 5.0, rtol=1e-3)


def test_friction_that_closes_nothing_asks_for_forces_beyond_any_limit() -> None:
    contacts = (pad((0.1, 0.0, 0.0), (-1, 0, 0), 1.5), pad((0.0, 0.1, 0.0), (0, -1, 0), 1.5))
    function = function_of(replace(hand_cell(), contacts=contacts))
    load = np.array([1.0, 2.0, 30.0, 0.0, 0.0, 0.0])
    assert np.array(function(load, [0.3, 0.3]))[0] > 1e9
    assert np.array(function(load, [1.4, 1.4]))[0] < 1e4


@pytest.mark.parametrize("kinds", KINDS)
def test_starts_balance_the_load_within_the_cones_and_at_rest_near_the_least_effort(
    kinds: tuple[str, ...],
) -> None:
    rng = np.random.default_rng(3)
    cell = random_grasp(rng, hand_cell(), kinds)
    upright = np.array([0.0, 0.0, 1.0])
    at_rest = np.concatenate([upright, np.cross(cell.payload.centre_of_mass, upright)])
    grasp = Grasp(cell)
    load, friction = ca.SX.sym("load", 6), ca.SX.sym("friction", 2)
    states, weight = grasp.start([load, friction])
    outputs = [patch.slack(state) for patch, state in zip(grasp.patches, states, strict=True)]
    outputs += [weight, grasp.effort([state[:6] for state in states], [load, friction])]
    start = ca.Function("start", [load, friction], [ca.vertcat(*outputs), *states])
    maps = [state_to_box(pad) for pad in cell.pads]
    disturbed = [0.05 * rng.normal(size=6) * [1, 1, 1, 0.1, 0.1, 0.1] for _ in range(8)]
    for asked in [at_rest, -at_rest, *[sign * at_rest + d for d in disturbed for sign in (1, -1)]]:
        found, *held = (np.array(v).ravel() for v in start(asked, friction_of(cell)))
        assert found[:-2].min() > 0.0
        balance = sum(A @ state for A, state in zip(maps, held, strict=True))
        np.testing.assert_allclose(balance, asked, atol=1e-9)
        if asked is at_rest:
            least = effort(least_wrenches(cell.pads, asked)) / 2.0
            assert least < found[-1] < least * (1.0 + 1.5 * REST_WEIGHT)
            assert found[-2] < START_WEIGHT


PATHS = (
    ("round", "round"),
    ("round", "rectangle"),
    ("rectangle", "rectangle"),
    ("rectangle", "round", "rectangle"),
)
DEGREES = {"round": 3.0, "rectangle": 4.0}
"""Of the barriers: the share of the effort that they add at most, over their weight."""


@cache
def grasp_of(kinds: tuple[str, ...]) -> Workcell:
    return random_grasp(np.random.default_rng(3), hand_cell(), kinds)


@cache
def soft(kinds: tuple[str, ...], weight: float) -> tuple[ca.Function, ca.Function]:
    return functions_of(grasp_of(kinds), weight)


def functions_of(cell: Workcell, weight: float) -> tuple[ca.Function, ca.Function]:
    program = SoftGrasp(Grasp(cell), weight)
    return program.first(), program.second()


def values(first: ca.Function, load: Array) -> tuple[Array, Array, Array]:
    """Normal forces (2,), their gradients (2, 6) and the state."""
    normal, slope, state = (np.array(value) for value in first(load))
    return normal[:, 0], slope.T, state[:, 0]


def curvatures(second: ca.Function, state: Array) -> Array:
    """(2, 6, 6) of both normal forces."""
    return np.array([np.array(second(state, weight)) for weight in np.eye(2)])


def effort_of(cell: Workcell, state: Array) -> float:
    """Sum of all squared forces of the states."""
    total, at = 0.0, 0
    for pad in cell.pads:
        total += state[at] ** 2 + pad.friction**2 * np.sum(state[at + 1 : at + 3] ** 2)
        at += 6 if pad.half_sides is None else 12
    return float(total)


@pytest.mark.parametrize("weight", [1e-6, 1e-4])
@pytest.mark.parametrize("kinds", PATHS)
def test_effort_is_least_but_for_the_barriers(kinds: tuple[str, ...], weight: float) -> None:
    cell, rng = grasp_of(kinds), np.random.default_rng(1)
    first, _ = soft(kinds, weight)
    for _ in range(5):
        load = random_load(rng)
        normal, _, state = values(first, load)
        wrenches = least_wrenches(cell.pads, load)
        least = float(np.sum(wrenches[:, :3] ** 2))
        share = effort_of(cell, state) / least - 1.0
        # What a barrier of this weight can leave at most.
        assert -1e-8 < share < 1.01 * weight * sum(DEGREES[kind] for kind in kinds)
        expected = np.bincount(cell.pad_robots, wrenches[:, 2], 2)
        np.testing.assert_allclose(normal, expected, atol=3.0 * np.sqrt(weight * least))


@pytest.mark.parametrize("weight", [1e-5, 1e-3])
@pytest.mark.parametrize("kinds", PATHS)
def test_derivatives_are_those_of_differences(kinds: tuple[str, ...], weight: float) -> None:
    first, second = soft(kinds, weight)
    rng = np.random.default_rng(2)
    for _ in range(4):
        load = random_load(rng)
        _, slope, state = values(first, load)
        bent = curvatures(second, state)
        # Differences of states, which are known to the last digits over the weight.
        step = 1e-5 * float(np.linalg.norm(load))
        one, two = (differences(first, load, h) for h in (step, 2.0 * step))
        of_values, of_slopes = ((4.0 * a - b) / 3.0 for a, b in zip(one, two, strict=True))
        np.testing.assert_allclose(slope, of_values, atol=1e-7 * np.abs(slope).max())
        scale = max(np.abs(bent).max(), np.abs(slope).max() / np.linalg.norm(load))
        np.testing.assert_allclose(bent, of_slopes, atol=2e-5 * scale)


def differences(first: ca.Function, load: Array, step: float) -> tuple[Array, Array]:
    """(2, 6) and (2, 6, 6) of forces and of their gradients, to second order in the step."""
    pairs = [
        (values(first, load + step * d), values(first, load - step * d)) for d in np.eye(len(load))
    ]
    of_values = np.column_stack([(a[0] - b[0]) / (2.0 * step) for a, b in pairs])
    of_slopes = np.stack([(a[1] - b[1]) / (2.0 * step) for a, b in pairs], axis=-1)
    return of_values, of_slopes


def test_where_patches_suffice_they_are_the_papers() -> None:
    """A load without moment through the middle of both patches: forces, slopes, curvature."""
    cell, weight = hand_cell(), 1e-7
    pads = replace(cell.contacts[0], friction=0.6), replace(cell.contacts[1], friction=0.9)
    first, second = functions_of(replace(cell, contacts=pads), weight)
    normal_axis, load = pads[0].T_box_pad[:3, 2], np.array([20.0, -7.0, 95.0, 0.0, 0.0, 0.0])
    force = ca.SX.sym("f", 3)
    f_n = ca.dot(force, ca.DM(normal_axis))
    f_t = ca.norm_2(force - f_n * ca.DM(normal_axis))
    tight = normal_force_branches(f_n, f_t, (0.6, 0.9))
    both = ca.vertcat(tight[0] + f_n, tight[0])
    paper = ca.Function(
        "paper",
        [force],
        [tight, both, ca.jacobian(both, force), *[ca.hessian(both[i], force)[0] for i in (0, 1)]],
    )
    branches, expected, slope, *bent = (np.array(value) for value in paper(load[:3]))
    assert branches[0] > branches[1:].max() + 1.0  # both cones tight
    normal, found, state = values(first, load)
    np.testing.assert_allclose(normal, expected[:, 0], rtol=1e-5)
    np.testing.assert_allclose(found[:, :3], slope, atol=1e-5)
    np.testing.assert_allclose(curvatures(second, state)[:, :3, :3], bent, atol=1e-5)


def squeeze_of(cell: Workcell, commanded: int) -> ca.Function:
    load, friction, share = ca.MX.sym("load", 6), ca.MX.sym("friction", 2), ca.MX.sym("share", 2)
    force = commanded_forces(GraspSqueeze(cell, commanded), load, friction, share, ca.MX.zeros(4))
    return ca.Function("commanded", [load, friction, share], [force])


def closed_grasp(rng: np.random.Generator, kinds: tuple[str, ...]) -> Workcell:
    """Also by smaller patches."""
    while not has_force_closure(
        smaller_patches(cell := random_grasp(rng, hand_cell(), kinds), 0.8)
    ):
        pass
    return cell


@pytest.mark.parametrize("kinds", KINDS)
@pytest.mark.parametrize("share", [1.0, 0.8])
def test_squeezes_agree_with_clarabel(kinds: tuple[str, ...], share: float) -> None:
    rng = np.random.default_rng(5)
    for commanded in (0, 1):
        cell = closed_grasp(rng, kinds)
        function, small = squeeze_of(cell, commanded), smaller_patches(cell, share)
        weights = np.where(np.array(cell.pad_robots) == commanded, 1.0, OTHER_WEIGHT)
        for _ in range(3):
            load = random_load(rng)
            found = np.array(function(load, friction_of(cell), [share, share])).ravel()
            expected = weights @ least_wrenches(small.pads, load, weights)[:, 2]
            # Next to nothing may have to be commanded.
            rounding = 4e-6 * float(np.linalg.norm(load[:3]))
            assert found[commanded] == pytest.approx(expected, rel=2e-5, abs=rounding)
            assert found[1 - commanded] > 0.0


def test_what_the_quick_look_holds_needs_no_more() -> None:
    rng = np.random.default_rng(6)
    held = 0
    for kinds in KINDS:
        cell = closed_grasp(rng, kinds)
        function, squeeze = squeeze_of(cell, 1), GraspSqueeze(cell, 1)
        load, friction, share = (ca.SX.sym(n, k) for n, k in (("l", 6), ("mu", 2), ("s", 2)))
        force = ca.SX.sym("force")
        slack = commanded_slack(squeeze, load, friction, share, ca.SX.zeros(4), force)
        look = ca.Function("look", [load, friction, share, force], [slack])
        for _ in range(10):
            asked, known = random_load(rng), (friction_of(cell), [0.9, 0.9])
            least = float(function(asked, *known)[1])
            assert float(look(asked, *known, 0.99 * least)) <= 0.0
            held += float(look(asked, *known, 3.0 * least)) > 0.0
    assert held >= 20


MASS, GRAVITY = 10.0, 9.81


def cell_of(
    height: float = 0.0, friction: float = 1.0, half_sides: tuple[float, float] | None = None
) -> Workcell:
    """A solid box between two pads across y, these a height above its centre."""
    cell = with_contacts(hand_cell(), friction=(friction, friction))
    cell = with_task(cell, allocation="soft-finger")
    contacts = []
    for contact in cell.contacts:
        T = contact.T_box_pad.copy()
        T[2, 3] = height
        contacts.append(replace(contact, T_box_pad=T, half_sides=half_sides))
    return replace(cell, contacts=(contacts[0], contacts[1]))


def sliding(contact: Contact, way: float) -> Array:
    """(n, 3) tangential force and torsion of a patch that slides about centres of rotation beside
    its middle, for unit normal force and friction: its exact limit curve, by quadrature.

    Args:
        way: angle of the tangential force from the pad's x axis [rad].
    """
    if contact.half_sides is None:
        r, angle = np.meshgrid((np.arange(200) + 0.5) / 200, np.arange(256) * 2.0 * np.pi / 256)
        at = np.stack([r * np.cos(angle), r * np.sin(angle)], axis=-1)
        points = contact.patch_radius * at.reshape(-1, 2)
        weight = r.ravel() / r.sum()
    else:
        x, y = contact.half_sides
        along = (np.arange(160) + 0.5) / 80 - 1.0
        points = np.array(np.meshgrid(x * along, y * along)).reshape(2, -1).T
        weight = np.full(len(points), 1.0 / len(points))
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
    contact = cell_of(half_sides=half_sides).contacts[0]
    errors = [
        asked_for(contact, wrench) - 1.0
        for way in (0.0, 0.5, 1.1, np.pi / 2)
        for wrench in sliding(contact, way)
    ]
    assert least < min(errors) <= max(errors) < most


def least(cell: Workcell, pose: Array, acceleration: Array) -> Array:
    """(2,) normal forces at a pose (6,) under an acceleration (3,) of the box."""
    second = np.concatenate([acceleration, np.zeros(3)])
    function = case_squeeze_function(cell)
    return np.asarray(function(pose, np.zeros(6), second, nominal_case(cell))).ravel()


def test_level_and_still_it_is_the_paper_s_force() -> None:
    for friction in (0.3, 1.0):
        found = least(cell_of(friction=friction), np.zeros(6), np.zeros(3))
        np.testing.assert_allclose(found, MASS * GRAVITY / (2.0 * friction), rtol=1e-9)


def test_a_box_that_hangs_pitched_below_its_pads_twists_them() -> None:
    """tau = m g h sin(pitch) is torsion: both pads reach the limit surface together."""
    height, pitch = 0.055, 0.5
    cell = cell_of(height=height)
    pose = np.array([0.0, 0.0, 1.0, 0.0, pitch, 0.0])
    force = least(cell, pose, np.zeros(3))
    weight = MASS * GRAVITY
    torsion = weight * height * np.sin(pitch)
    radius = cell.contacts[0].patch_radius
    assert force[0] == pytest.approx(force[1], rel=1e-9)
    wrench = np.array([weight / 2.0, 0.0, torsion / 2.0]) / force[0]
    curve = sliding(cell.contacts[0], 0.0)
    at = np.argmin(np.abs(np.hypot(*curve[:, :2].T) / curve[:, 2] - wrench[0] / wrench[2]))
    scale = np.linalg.norm(wrench * [1, 1, 1 / radius]) / np.linalg.norm(
        curve[at] * [1, 1, 1 / radius]
    )
    assert scale == pytest.approx(1.0, abs=0.03)  # the curve's points are so far apart


def test_a_pull_along_y_above_the_centre_loads_one_pad_more() -> None:
    """m a h turns about x: half of it over the distance of the pads is added to one tangential
    force and taken off the other, beside what the pull itself adds to one normal force."""
    height, friction, pull = 0.10, 0.8, 1.0
    cell = cell_of(height=height, friction=friction)
    apart = abs(cell.contacts[0].T_box_pad[1, 3] - cell.contacts[1].T_box_pad[1, 3])
    force = least(cell, np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0]), np.array([0.0, pull, 0.0]))
    more = MASS * pull * height / apart
    needed = np.array([MASS * GRAVITY / 2 + more, MASS * GRAVITY / 2 - more]) / friction
    # Contact 1 presses towards -y: pad 2 gives the pull.
    assert force[1] - force[0] == pytest.approx(MASS * pull, rel=1e-9)
    assert force[0] == pytest.approx(max(needed[0], needed[1] - MASS * pull), rel=1e-6)


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
