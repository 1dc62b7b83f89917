"""Forces of pads that choose their pressure: against clarabel, by their laws, their derivatives."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from functools import cache

import casadi as ca
import clarabel
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from symbolic.array import Array
from symbolic.contact.central_path import FINAL_WEIGHT, NEAR, START_WEIGHT
from symbolic.contact.force_closure import has_force_closure, smaller_patches, state_to_box
from symbolic.contact.grasp import REST_WEIGHT, Grasp, Objective, balance_of, facing_wrenches
from symbolic.contact.paper import allocate, normal_force_branches
from symbolic.contact.soft_grasp import SoftGrasp
from symbolic.contact.worst_cases import (
    OTHER_WEIGHT,
    GraspSqueeze,
    commanded_forces,
    commanded_slack,
)
from symbolic.errors import SettingsError
from symbolic.records import Contact, Workcell
from tests.symbolic.cells import hand_cell, with_contacts, with_task
from tests.symbolic.contact.oracle import (
    Case,
    effort,
    friction_of,
    function_of,
    in_box,
    least_wrenches,
    random_grasp,
    random_load,
    solved,
    wrenches,
)

# --- two round pads that face one another ---

GAP = 6.0 * NEAR * FINAL_WEIGHT
"""Share by which a found effort may exceed the least one: both patches' degrees times the weight at
which the steps end."""

SAME = 2.0 * np.sqrt(GAP)
"""Largest difference of forces that are found for one case in two ways, as a share of their length.

Half the squared length is strongly convex with modulus one: what is within `GAP` of its least value
is within the root of that, as a share, of the place of it. Most differ by a hundredth of that."""

REGIMES = (
    "patch suffices",
    "patch does not suffice",
    "pressure at the rim 1",
    "pressure at the rim 2",
    "friction used up 1",
    "friction used up 2",
    "torsion",
    "friction not used up",
    "pads beside one another",
)


@cache
def facing(objective: Objective = "effort", differentiable: bool = False) -> ca.Function:
    """Per pad forces (3,), shift (2,) and torsion."""
    force, moment, arms = ca.MX.sym("force", 3), ca.MX.sym("moment", 3), ca.MX.sym("arms", 3, 2)
    friction, radius = ca.MX.sym("friction", 2), ca.MX.sym("radius", 2)
    balance = balance_of(force, moment, (arms[:, 0], arms[:, 1]))
    found = facing_wrenches(balance, friction, radius, objective, differentiable)
    columns = []
    for sign, own in zip((1.0, -1.0), ca.vertsplit(found, 6), strict=True):
        tangent, shift = own[1:3], own[3:5] / own[0]
        torsion = own[5] - (shift[0] * tangent[1] - shift[1] * tangent[0])
        columns.append(ca.vertcat(tangent, sign * own[0], shift, torsion))
    inputs = [force, moment, arms, friction, radius]
    return ca.Function("joint", inputs, [ca.horzcat(*columns)])


def held(case: Case, objective: Objective = "effort") -> tuple[Array, Array, Array]:
    """Forces (2, 3), shifts (2, 2) and torsions (2,)."""
    given = case.force, case.moment, case.arms.T, case.friction, case.radius
    result: Array = np.array(facing(objective)(*given)).T
    return result[:, :3], result[:, 3:5], result[:, 5]


def random_case(rng: np.random.Generator) -> Case:
    """Boxes of any proportions, level or tumbling, held anywhere near their middle."""
    friction, radius = rng.uniform(0.2, 1.2, 2), rng.uniform(0.005, 0.05, 2)
    if rng.random() < 0.4:
        friction[1], radius[1] = friction[0], radius[0]
    length, force = rng.uniform(0.15, 0.6), rng.normal(size=3)
    if rng.random() < 0.3:
        force[:2] *= 0.05
    force *= rng.uniform(10.0, 150.0) / np.linalg.norm(force)
    beside = 0.5 * radius.sum() * rng.uniform(-1.0, 1.0, 2) * (rng.random() < 0.5)
    centre = np.array([*rng.normal(scale=0.03, size=2), rng.uniform(-0.3, 0.3) * length])
    centre *= rng.choice([0.1, 1.0, 2.0])
    arms = np.array([[*beside, -length / 2.0], [0.0, 0.0, length / 2.0]]) - centre
    return Case(force, rng.normal(size=3) * rng.choice([0.1, 1.0, 5.0]), arms, friction, radius)


def slack(case: Case, forces: Array, shifts: Array, torsion: Array) -> tuple[Array, Array]:
    """What friction and patch leave, as shares (2,), by the ellipse at the centre of pressure."""
    normal = forces[:, 2] * [1.0, -1.0]
    lever = np.sqrt(np.maximum(case.radius**2 - np.sum(shifts**2, axis=1), 0.0))
    tangential = np.linalg.norm(forces[:, :2], axis=1)
    used = np.hypot(tangential, torsion / np.maximum(lever, 1e-12))
    rim = 1.0 - np.linalg.norm(shifts, axis=1) / case.radius
    return 1.0 - used / (case.friction * normal), rim


def regimes(case: Case, forces: Array, shifts: Array, torsion: Array) -> set[str]:
    friction, rim = slack(case, forces, shifts, torsion)
    mu = case.friction[0], case.friction[1]
    paper = effort(np.reshape(allocate(ca.DM(case.force), ca.DM([0, 0, 1]), mu)[2], (2, 3)))
    found = {REGIMES[1] if effort(forces) > (1.0 + 1e-5) * paper else REGIMES[0]}
    for i in (0, 1):
        found |= {f"pressure at the rim {i + 1}"} if rim[i] < 1e-4 else set()
        found |= {f"friction used up {i + 1}"} if friction[i] < 1e-4 else set()
    capacity = case.friction * np.abs(forces[:, 2]) * case.radius
    found |= {"torsion"} if (np.abs(torsion) > 0.1 * capacity).any() else set()
    found |= {"friction not used up"} if (friction > 0.05).all() else set()
    beside = np.linalg.norm((case.arms[0] - case.arms[1])[:2])
    return found | ({"pads beside one another"} if beside > 0.2 * case.radius.sum() else set())


@pytest.mark.parametrize(
    ("cases", "least"), [(150, 5), pytest.param(2000, 60, marks=pytest.mark.slow)]
)
def test_facing_pads_agree_with_clarabel_within_both_patches(cases: int, least: int) -> None:
    rng = np.random.default_rng(1)
    hits: Counter[str] = Counter()
    for _ in range(cases):
        case = random_case(rng)
        forces, shifts, torsion = held(case)
        expected, _ = case.least()
        assert effort(forces) == pytest.approx(effort(expected), rel=1e-6)
        # Where the effort is flat, forces differ by the root of what the efforts may.
        size = np.sqrt(effort(forces))
        np.testing.assert_allclose(forces / size, expected / size, atol=1e-4)
        np.testing.assert_allclose(forces.sum(axis=0), case.force, atol=1e-9)
        points = case.arms + np.column_stack([shifts, np.zeros(2)])
        moment = np.cross(points, forces).sum(axis=0) + torsion.sum() * np.eye(3)[2]
        np.testing.assert_allclose(moment, case.moment, atol=1e-9)
        assert min(map(np.min, slack(case, forces, shifts, torsion))) > 0.0
        hits.update(regimes(case, forces, shifts, torsion))
    assert min(hits[name] for name in REGIMES) >= least, hits


def level_box(half_height: float, offset: float) -> Case:
    """10 kg, friction 0.5, contacts 0.4 m apart; a points up, the centre of mass lies `offset`
    towards contact 1. The planar case: discs of that radius, nothing out of the plane."""
    arms = np.array([[0.0, 0.0, -0.2 + offset], [0.0, 0.0, 0.2 + offset]])
    both = np.ones(2)
    return Case(np.array([98.1, 0.0, 0.0]), np.zeros(3), arms, 0.5 * both, half_height * both)


@pytest.mark.parametrize(
    ("half_height", "offset", "published"),
    [(0.02, 0.0, 98.1), (0.02, 0.05, 102.2), (0.005, 0.05, 116.8), (1e-6, 0.05, 122.6)],
)
def test_known_cases(half_height: float, offset: float, published: float) -> None:
    """Friction of the nearer contact and both rims are used up, or friction alone."""
    forces, _, torsion = held(level_box(half_height, offset))
    weight, mu, length = 98.1, 0.5, 0.4
    # About pad 2: mu N L and both rims' 2 h N carry weight (L / 2 + offset).
    tilted = weight * (length / 2.0 + offset) / (mu * length + 2.0 * half_height)
    expected = max(tilted, weight / (2.0 * mu))
    np.testing.assert_allclose(forces[:, 2], [expected, -expected], rtol=2e-7)
    assert expected == pytest.approx(published, abs=0.05)
    np.testing.assert_allclose(torsion, 0.0, atol=1e-5)


def test_nothing_to_carry_needs_next_to_nothing() -> None:
    forces, _, _ = held(replace(level_box(0.02, 0.0), force=np.zeros(3)))
    assert np.isfinite(forces).all()
    assert np.abs(forces).max() < 1e-6


@given(seed=st.integers(0, 2**31))
def test_derivatives_of_facing_pads_are_those_of_the_forces(seed: int) -> None:
    case = random_case(np.random.default_rng(seed))
    names = ("force", "moment", "arms", "friction", "radius")
    symbols = [ca.MX.sym(name, *np.array(getattr(case, name)).T.shape) for name in names]
    normal = facing("effort", differentiable=True)(*symbols)[2, :].T
    motion = ca.vertcat(symbols[0], symbols[1])
    function = ca.Function("derivatives", symbols, [normal, ca.jacobian(normal, motion)])

    def at(change: Array) -> list[Array]:
        force, moment = case.force + change[:3], case.moment + change[3:]
        values = function(force, moment, case.arms.T, case.friction, case.radius)
        return [np.array(value) for value in values]

    value, jacobian = at(np.zeros(6))
    forces = held(case)[0]
    np.testing.assert_allclose(value[:, 0], forces[:, 2], atol=SAME * np.sqrt(effort(forces)))
    size = max(1.0, float(np.abs(jacobian).max()))
    for k, direction in enumerate(1e-4 * np.eye(6)):
        difference = (at(direction)[0] - at(-direction)[0]) / 2e-4
        np.testing.assert_allclose(difference[:, 0], jacobian[:, k], atol=1e-4 * size)


def test_the_least_squeeze_agrees_with_clarabel() -> None:
    rng = np.random.default_rng(3)
    for _ in range(200):
        case = random_case(rng)
        found = held(case, "squeeze")[0][:, 2]
        forces, unsure = case.least(squeeze=True)
        expected = forces[0, 2] - forces[1, 2]
        assert unsure < 1e-3 * expected
        assert abs(found[0] - found[1] - expected) <= GAP * expected + unsure
        assert found.sum() == pytest.approx(case.force[2], abs=1e-9)


# --- pads anywhere ---

KINDS = (
    ("round", "round"),
    ("round", "rectangle"),
    ("rectangle", "rectangle"),
    ("round", "round", "round"),
    ("rectangle", "round", "rectangle"),
    ("rectangle",) * 4,
)


@pytest.mark.parametrize("grasps", [2, pytest.param(60, marks=pytest.mark.slow)])
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


@pytest.mark.parametrize("seed", range(3))
def test_a_rectangle_needs_no_less_than_carons_cone_and_no_more_than_the_one_within(
    seed: int,
) -> None:
    """Its friction pyramids hold the circular cones, those of friction over sqrt(2) lie within."""
    rng = np.random.default_rng(seed)
    cell = random_grasp(rng, hand_cell(), ("rectangle", "rectangle"))
    load = random_load(rng)
    least, most = (caron_effort(cell.pads, load, share) for share in (1.0, 0.5**0.5))
    assert least * (1.0 - 1e-6) <= effort(wrenches(cell, load)) <= most * (1.0 + 1e-6)


def caron_effort(pads: tuple[Contact, ...], load: Array, share: float) -> float:
    """Least effort by clarabel with Caron's inequalities; infinite where there is none."""
    rows = np.zeros((len(pads), 16, len(pads), 6))
    for i, pad in enumerate(pads):
        rows[i, :, i] = caron_rows(pad, share * pad.friction)
    size, n = float(np.linalg.norm(load)), 16 * len(pads)
    balance = np.hstack([in_box(pad) for pad in pads]), load / size, [clarabel.ZeroConeT(6)]
    within = rows.reshape(n, -1), np.zeros(n), [clarabel.NonnegativeConeT(n)]
    squares = np.diag(np.tile([1.0, 1, 1, 0, 0, 0], len(pads)))
    found = solved(squares, np.zeros(len(squares)), [balance, within])
    return float("inf") if found is None else size**2 * effort(found[0].reshape(-1, 6))


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


def on_adjacent_faces(mu: float) -> Workcell:
    """Pads of 1 mm radius as far from the edge."""
    contacts = []
    for place in np.eye(3)[:2]:
        x = np.cross(-place, [0.3, 0.5, 0.8])
        x /= np.linalg.norm(x)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = np.column_stack([x, np.cross(-place, x), -place]), 0.1 * place
        contacts.append(Contact(T, mu, 1e-3))
    return replace(hand_cell(), contacts=(contacts[0], contacts[1]))


def test_adjacent_faces_hold_where_both_cones_reach_across_the_edge() -> None:
    """The line between points as far from the edge lies at 45 degrees to both faces: friction
    above one, with five percent to spare."""
    with pytest.raises(SettingsError, match="do not close their grasp"):
        Grasp(on_adjacent_faces(1.02))
    # A force along the bisector: its halves act at the pads, at 45 degrees to both normals.
    found = wrenches(on_adjacent_faces(1.1), np.array([-10.0, -10.0, 0.0, 0.0, 0.0, 0.0]))
    np.testing.assert_allclose(found[:, 2], 5.0, rtol=1e-3)


def test_friction_that_closes_nothing_asks_for_forces_beyond_any_limit() -> None:
    function = function_of(on_adjacent_faces(1.5))
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
        found, *own = (np.array(v).ravel() for v in start(asked, friction_of(cell)))
        assert found[:-2].min() > 0.0
        balance = sum(A @ state for A, state in zip(maps, own, strict=True))
        np.testing.assert_allclose(balance, asked, atol=1e-9)
        if asked is at_rest:
            least = effort(least_wrenches(cell.pads, asked)) / 2.0
            assert least < found[-1] < least * (1.0 + 1.5 * REST_WEIGHT)
            assert found[-2] < START_WEIGHT


# --- on the central path ---

DEGREES = {"round": 3.0, "rectangle": 4.0}
"""Of the barriers: the share of the effort that they add at most, over their weight."""


@cache
def grasp_of(kinds: tuple[str, ...]) -> Workcell:
    even = kinds[0] == "even"
    cell = with_task(hand_cell(), allocation="soft-finger" if even else "paper")
    return random_grasp(np.random.default_rng(3), cell, kinds[1:] if even else kinds)


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
@pytest.mark.parametrize("kinds", [*KINDS[:3], KINDS[4]])
def test_effort_is_least_but_for_the_barriers(kinds: tuple[str, ...], weight: float) -> None:
    cell, rng = grasp_of(kinds), np.random.default_rng(1)
    first, _ = functions_of(cell, weight)
    for _ in range(5):
        load = random_load(rng)
        normal, _, state = values(first, load)
        expected = least_wrenches(cell.pads, load)
        share = effort_of(cell, state) / effort(expected) - 1.0
        # What a barrier of this weight can leave at most.
        assert -1e-8 < share < 1.01 * weight * sum(DEGREES[kind] for kind in kinds)
        normals = np.bincount(cell.pad_robots, expected[:, 2], 2)
        tolerance = 3.0 * np.sqrt(weight * effort(expected))
        np.testing.assert_allclose(normal, normals, atol=tolerance)


EVEN = [("even", *kinds) for kinds in (KINDS[0], KINDS[1], KINDS[3])]


@pytest.mark.parametrize("weight", [1e-5, 1e-3])
@pytest.mark.parametrize("kinds", [*KINDS[:3], KINDS[4], *EVEN])
def test_derivatives_are_those_of_differences(kinds: tuple[str, ...], weight: float) -> None:
    first, second = functions_of(grasp_of(kinds), weight)
    rng, exact = np.random.default_rng(2), 1.0 if kinds[0] != "even" else 1e2
    for _ in range(4 if exact == 1.0 else 1):
        load = random_load(rng)
        _, slope, state = values(first, load)
        bent = curvatures(second, state)
        # Differences of states, which are known to the last digits over the weight.
        step = 1e-5 * float(np.linalg.norm(load))
        one, two = (differences(first, load, h) for h in (step, 2.0 * step))
        of_values, of_slopes = ((4.0 * a - b) / 3.0 for a, b in zip(one, two, strict=True))
        np.testing.assert_allclose(slope, of_values, atol=exact * 1e-7 * np.abs(slope).max())
        scale = max(np.abs(bent).max(), np.abs(slope).max() / np.linalg.norm(load))
        np.testing.assert_allclose(bent, of_slopes, atol=exact * 2e-5 * scale)


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
    cell = with_contacts(hand_cell(), friction=(0.6, 0.9))
    first, second = functions_of(cell, 1e-7)
    normal_axis, load = cell.contacts[0].T_box_pad[:3, 2], np.array([20.0, -7.0, 95.0, 0, 0, 0])
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


# --- commanded forces ---


def squeeze_of(cell: Workcell, commanded: int) -> tuple[ca.Function, ca.Function]:
    """Load, friction and sizes of patches to the commanded forces; the quick look, which takes a
    commanded force last."""
    squeeze = GraspSqueeze(cell, commanded)
    load, friction, share = ca.MX.sym("load", 6), ca.MX.sym("friction", 2), ca.MX.sym("share", 2)
    force = commanded_forces(squeeze, load, friction, share, ca.MX.zeros(4))
    given = [ca.SX.sym(n, k) for n, k in (("l", 6), ("mu", 2), ("s", 2), ("force", 1))]
    asked, mu, size, pressed = given
    left = commanded_slack(squeeze, asked, mu, size, ca.SX.zeros(4), pressed)
    return (
        ca.Function("commanded", [load, friction, share], [force]),
        ca.Function("look", given, [left]),
    )


def closed_grasp(rng: np.random.Generator, kinds: tuple[str, ...]) -> Workcell:
    """Also by smaller patches."""
    while not has_force_closure(
        smaller_patches(cell := random_grasp(rng, hand_cell(), kinds), 0.8)
    ):
        pass
    return cell


@pytest.mark.parametrize("kinds", KINDS)
def test_squeezes_agree_with_clarabel_and_what_a_quick_look_holds_needs_no_more(
    kinds: tuple[str, ...],
) -> None:
    rng, known_to_hold = np.random.default_rng(5), 0
    for commanded in (0, 1):
        cell = closed_grasp(rng, kinds)
        function, look = squeeze_of(cell, commanded)
        weights = np.where(np.array(cell.pad_robots) == commanded, 1.0, OTHER_WEIGHT)
        for share in (1.0, 0.8, 1.0, 0.8):
            load, small = random_load(rng), smaller_patches(cell, share)
            known = load, friction_of(cell), [share, share]
            found = np.array(function(*known)).ravel()
            expected = weights @ least_wrenches(small.pads, load, weights)[:, 2]
            # Next to nothing may have to be commanded.
            rounding = 4e-6 * float(np.linalg.norm(load[:3]))
            assert found[commanded] == pytest.approx(expected, rel=2e-5, abs=rounding)
            assert found[1 - commanded] > 0.0
            assert float(look(*known, 0.99 * found[commanded])) <= 0.0
            known_to_hold += float(look(*known, 10.0 * found[commanded])) > 0.0
    assert known_to_hold >= 2
