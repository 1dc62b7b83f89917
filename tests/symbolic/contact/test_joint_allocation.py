"""The joint allocation: least forces by conic programs, the load's values and slopes."""

from __future__ import annotations

from collections import Counter

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from codegen.lanes import lane_text
from codegen.source import generated_c
from studies.research.plain.motion import GRAVITY, angular_rates, rotation
from symbolic.array import Array
from symbolic.contact.central_path import FINAL_WEIGHT, NEAR
from symbolic.contact.grasp import Objective, balance_of, facing_wrenches
from symbolic.contact.load import RESIDUAL_TOLERANCE, load_function
from symbolic.contact.paper import allocate
from symbolic.records import Workcell
from tests.symbolic.cells import call, with_contacts, with_payload, with_task
from tests.symbolic.contact.joint_oracle import Case, least_squeeze_within, least_wrenches
from tests.symbolic.contact.test_payload_load import (
    load,
    random_cell,
    random_motion,
    ten_kilogram_cell,
)

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


def _function(objective: Objective, differentiable: bool = False) -> ca.Function:
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


FUNCTION = _function("effort")
DIFFERENTIABLE = _function("effort", differentiable=True)
SQUEEZE = _function("squeeze")


def held(case: Case) -> tuple[Array, Array, Array]:
    """Forces (2, 3), shifts (2, 2) and torsions (2,)."""
    result: Array = np.array(
        FUNCTION(case.force, case.moment, case.arms.T, case.friction, case.radius)
    ).T
    return result[:, :3], result[:, 3:5], result[:, 5]


def effort(forces: Array) -> float:
    return float(np.sum(forces**2))


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


def paper_effort(case: Case) -> float:
    result = allocate(ca.DM(case.force), ca.DM([0, 0, 1]), (case.friction[0], case.friction[1]))
    return effort(np.array([result.force_1, result.force_2]).reshape(2, 3))


def regimes(case: Case, forces: Array, shifts: Array, torsion: Array) -> set[str]:
    friction, rim = slack(case, forces, shifts, torsion)
    more = effort(forces) > (1.0 + 1e-5) * paper_effort(case)
    found = {REGIMES[1] if more else REGIMES[0]}
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
def test_agrees_with_clarabel(cases: int, least: int) -> None:
    rng = np.random.default_rng(1)
    hits: Counter[str] = Counter()
    for _ in range(cases):
        case = random_case(rng)
        forces, shifts, torsion = held(case)
        expected = least_wrenches(case)
        assert effort(forces) == pytest.approx(effort(expected[:, :3]), rel=1e-6)
        # Where the effort is flat, forces differ by the root of what the efforts may.
        size = np.sqrt(effort(forces))
        np.testing.assert_allclose(forces / size, expected[:, :3] / size, atol=1e-4)
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
    [
        (0.02, 0.0, 98.1),
        (0.02, 0.05, 102.2),
        (0.01, 0.05, 111.5),
        (0.005, 0.05, 116.8),
        (1e-6, 0.05, 122.6),
    ],
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


@given(seed=st.integers(0, 2**31))
def test_balances_force_and_moment_within_both_patches(seed: int) -> None:
    case = random_case(np.random.default_rng(seed))
    forces, shifts, torsion = held(case)
    np.testing.assert_allclose(forces.sum(axis=0), case.force, atol=1e-9)
    points = case.arms + np.column_stack([shifts, np.zeros(2)])
    moment = np.cross(points, forces).sum(axis=0) + torsion.sum() * np.eye(3)[2]
    np.testing.assert_allclose(moment, case.moment, atol=1e-9)
    friction, rim = slack(case, forces, shifts, torsion)
    assert friction.min() > 0.0
    assert rim.min() > 0.0


@given(seed=st.integers(0, 2**31))
def test_derivatives_are_those_of_the_forces(seed: int) -> None:
    case = random_case(np.random.default_rng(seed))
    names = ("force", "moment", "arms", "friction", "radius")
    symbols = [ca.MX.sym(name, *np.array(getattr(case, name)).T.shape) for name in names]
    normal = DIFFERENTIABLE(*symbols)[2, :].T
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


def test_nothing_to_carry_needs_next_to_nothing() -> None:
    case = level_box(0.02, 0.0)
    nothing = Case(np.zeros(3), np.zeros(3), case.arms, case.friction, case.radius)
    forces, _, _ = held(nothing)
    assert np.isfinite(forces).all()
    assert np.abs(forces).max() < 1e-6


def test_least_squeeze_agrees_with_clarabel() -> None:
    rng = np.random.default_rng(3)
    for _ in range(200):
        case = random_case(rng)
        found: Array = np.array(
            SQUEEZE(case.force, case.moment, case.arms.T, case.friction, case.radius)
        )[2]
        expected, unsure = least_squeeze_within(case)
        assert unsure < 1e-3 * expected
        assert abs(found[0] - found[1] - expected) <= GAP * expected + unsure
        assert found.sum() == pytest.approx(case.force[2], abs=1e-9)


def joint(cell: Workcell) -> Workcell:
    return with_task(cell, allocation="joint")


def needed(cell: Workcell, pose: Array, rate: Array, second: Array) -> tuple[Array, Array, Array]:
    """Force and moment about the centre of mass that a motion asks for, and the latter's place
    from the box centre; (3,) each, world frame."""
    R, payload = rotation(pose[3:]), cell.payload
    omega, alpha = angular_rates(pose[3:], rate[3:], second[3:])
    c = R @ payload.centre_of_mass
    acceleration = second[:3] + np.cross(alpha, c) + np.cross(omega, np.cross(omega, c))
    inertia = R @ payload.inertia @ R.T
    moment = inertia @ alpha + np.cross(omega, inertia @ omega)
    return payload.mass * (acceleration - GRAVITY), moment, c


def box_case(cell: Workcell, motion: tuple[Array, Array, Array]) -> Case:
    """What a motion asks of the contacts, in the axes of the first pad."""
    force, moment, _ = needed(cell, *motion)
    R_box_pad = cell.contacts[0].T_box_pad[:3, :3]
    to_pad = (rotation(motion[0][3:]) @ R_box_pad).T
    points = np.array([contact.T_box_pad[:3, 3] for contact in cell.contacts])
    return Case(
        to_pad @ force,
        to_pad @ moment,
        (points - cell.payload.centre_of_mass) @ R_box_pad,
        np.array([contact.friction for contact in cell.contacts]),
        np.array([contact.patch_radius for contact in cell.contacts]),
    )


@given(seed=st.integers(0, 2**31), radius=st.floats(0.002, 0.2))
def test_is_the_papers_where_the_patches_suffice_and_costs_more_where_not(
    seed: int, radius: float
) -> None:
    rng = np.random.default_rng(seed)
    cell = with_contacts(random_cell(rng), patch_radius=(radius, radius))
    motion = random_motion(rng)
    paper, ours = load(cell, *motion), load(joint(cell), *motion)
    force = paper["contact_force"].reshape(2, 3)
    carried = np.linalg.norm(paper["moment_residual"]) <= (
        RESIDUAL_TOLERANCE * 0.4 * np.linalg.norm(force.sum(axis=0))
    )
    if carried and paper["pressure_shift"].max() <= radius:
        for name, value in paper.items():
            np.testing.assert_array_equal(ours[name], value, err_msg=name)
    else:
        effort = [float(np.sum(found["contact_force"] ** 2)) for found in (paper, ours)]
        assert effort[1] >= (1.0 - 1e-12) * effort[0]
        assert ours["pressure_shift"].max() <= radius


@given(seed=st.integers(0, 2**31))
def test_wrenches_balance_the_motion(seed: int) -> None:
    rng = np.random.default_rng(seed)
    cell = with_contacts(joint(random_cell(rng)), patch_radius=(0.01, 0.02))
    motion = random_motion(rng)
    result = load(cell, *motion)
    force, moment, c = needed(cell, *motion)
    wrenches = np.array([result["wrench_1"], result["wrench_2"]])
    arms = [rotation(motion[0][3:]) @ contact.T_box_pad[:3, 3] - c for contact in cell.contacts]
    np.testing.assert_allclose(wrenches[:, :3].sum(axis=0), force, atol=1e-8)
    exerted = wrenches[:, 3:].sum(axis=0) + np.cross(arms, wrenches[:, :3]).sum(axis=0)
    np.testing.assert_allclose(exerted, moment, atol=1e-8)
    np.testing.assert_allclose(result["moment_residual"], 0.0, atol=1e-8)
    np.testing.assert_array_equal(result["contact_force"], wrenches[:, :3].ravel())


def test_loads_agree_with_clarabel() -> None:
    rng = np.random.default_rng(5)
    beyond = 0
    for _ in range(40):
        cell = with_contacts(random_cell(rng), patch_radius=(0.008, 0.015))
        motion = random_motion(rng)
        force = load(joint(cell), *motion)["contact_force"]
        expected = least_wrenches(box_case(cell, motion))[:, :3]
        assert float(force @ force) == pytest.approx(float(np.sum(expected**2)), rel=1e-6)
        shift = load(cell, *motion)["pressure_shift"]
        beyond += bool((shift > [0.008, 0.015]).any())
    assert beyond >= 20


def test_a_moment_that_no_shift_carries_is_carried_by_torsion() -> None:
    """In free fall nothing is tangential, so that the paper leaves a moment about the normal."""
    cell = with_payload(ten_kilogram_cell(0.5), inertia=np.eye(3))
    motion = np.zeros(6), np.zeros(6), np.array([0.0, 0.0, -9.81, 0.0, 1.0, 0.0])
    assert np.linalg.norm(load(cell, *motion)["moment_residual"]) == pytest.approx(1.0)
    result = load(joint(cell), *motion)
    np.testing.assert_allclose(result["moment_residual"], 0.0, atol=1e-8)
    # Both rims: 2 mu N r = 1 N m.
    np.testing.assert_allclose(result["normal_force"], 1.0 / (2 * 0.5 * 0.0315), rtol=1e-6)


def test_derivatives_pass_through_the_choice() -> None:
    cell = with_contacts(joint(ten_kilogram_cell()), patch_radius=(0.01, 0.01))
    cell = with_payload(cell, centre_of_mass=np.array([0.0, 0.05, 0.0]))
    function = load_function(cell)
    jacobian = function.factory("jacobian", function.name_in(), ["jac:normal_force:second_rate"])
    motion = np.zeros(6), np.zeros(6), np.array([0.3, 0.2, 0.1, 0.0, 0.0, 0.0])
    found = np.array(jacobian(*motion))
    for k, step in enumerate(1e-4 * np.eye(6)):
        ends = [
            call(function, motion[0], motion[1], motion[2] + sign * step)["normal_force"]
            for sign in (1.0, -1.0)
        ]
        np.testing.assert_allclose(found[:, k], (ends[0] - ends[1]) / 2e-4, atol=1e-4)


def test_runs_in_lanes() -> None:
    """A batch is evaluated side by side only if every construct of the function is known there."""
    function = load_function(joint(ten_kilogram_cell()))
    assert lane_text(generated_c([function]), "joint") is not None
