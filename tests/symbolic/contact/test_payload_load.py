"""The wrench that a payload asks for, and the contact forces of the paper that give it."""

from __future__ import annotations

import casadi as ca
import clarabel
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from codegen.lanes import lane_text
from codegen.source import generated_c
from studies.research.plain.motion import PLAIN_GRAVITY, angular_rates, rotation, sample_load
from symbolic.array import Array
from symbolic.contact.load import load_function
from symbolic.contact.paper import allocate, normal_force_branches
from symbolic.contact.soft_finger import SoftPatch, least_soft_squeeze
from symbolic.contact.worst_cases import CASE_SIZE, case_squeeze_function
from symbolic.records import Workcell
from tests.symbolic.cells import (
    call,
    hand_cell,
    solid_box,
    with_contacts,
    with_payload,
    with_task,
)
from tests.symbolic.contact.oracle import least_on_grids, random_grasp, solved


def load(cell: Workcell, pose: Array, rate: Array, second: Array) -> dict[str, Array]:
    return call(load_function(cell), pose, rate, second)


def at_rest(
    cell: Workcell, acceleration: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> dict[str, Array]:
    """Level box without velocity and with a given acceleration of its centre."""
    pose = np.array([0.1, -0.2, 0.8, 0.0, 0.0, 0.0])
    return load(cell, pose, np.zeros(6), np.concatenate([acceleration, np.zeros(3)]))


def ten_kilogram_cell(mu: float = 0.5) -> Workcell:
    cell = with_payload(hand_cell(), mass=10.0, inertia=solid_box(10.0, [0.3, 0.4, 0.25]))
    return with_contacts(cell, friction=(mu, mu))


def random_cell(rng: np.random.Generator) -> Workcell:
    mass = rng.uniform(1.0, 20.0)
    cell = with_payload(
        hand_cell(),
        mass=mass,
        centre_of_mass=rng.uniform(-0.05, 0.05, 3),
        inertia=solid_box(mass, [0.3, 0.4, 0.25]) + 0.01 * mass * np.ones((3, 3)) * 0.1,
    )
    friction = rng.uniform(0.3, 1.5, 2)
    return with_contacts(cell, friction=(friction[0], friction[1]))


def random_motion(rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """A box pose within moderate tilt, its rate and second rate."""
    pose = np.concatenate([rng.uniform(-1.0, 1.0, 3), rng.uniform(-0.6, 0.6, 3)])
    return pose, rng.normal(scale=0.7, size=6), rng.normal(scale=2.0, size=6)


def rounding(result: dict[str, Array]) -> float:
    """Tolerance for two ways of computing a load.

    An unloaded contact leaves one direction of moment to the damping of the solve.
    """
    n = result["normal_force"]
    return 1e-8 if n.min() > 1e-3 * n.max() else 1e-6


# m = 10 kg, mu = 0.5, contacts 0.4 m apart: figures confirmed to 1e-4 N by an independent
# program for the level box.
@pytest.mark.parametrize(
    ("acceleration", "expected"),
    [
        ((0.0, 0.0, 0.0), (98.1, 98.1)),
        ((0.0, 0.0, 2.0), (118.1, 118.1)),
        # Contact 1 on the +y face presses towards -y: accelerated that way it is the pushed side.
        ((0.0, -1.0, 0.0), (103.1, 93.1)),
        ((0.0, 1.0, 0.0), (93.1, 103.1)),
    ],
)
def test_reference_figures(
    acceleration: tuple[float, float, float], expected: tuple[float, float]
) -> None:
    result = at_rest(ten_kilogram_cell(), acceleration)
    np.testing.assert_allclose(result["normal_force"], expected, atol=1e-4)


@pytest.mark.parametrize("offset", [0.01, 0.025, 0.04])
def test_offset_along_the_squeeze_axis_is_carried_by_the_normal_forces(offset: float) -> None:
    """m g dy = N (d_1 + d_2) with opposite vertical shifts and N = m g / (2 mu)."""
    mu = 0.5
    cell = with_payload(ten_kilogram_cell(mu), centre_of_mass=np.array([0.0, offset, 0.0]))
    result = at_rest(cell)
    np.testing.assert_allclose(result["pressure_shift"], mu * offset, rtol=1e-9)
    assert result["shift_vector"][2] == pytest.approx(-result["shift_vector"][5], rel=1e-9)


@given(seed=st.integers(0, 2**31))
def test_agrees_with_the_plain_reference(seed: int) -> None:
    rng = np.random.default_rng(seed)
    cell, motion = random_cell(rng), random_motion(rng)
    expected = sample_load(cell, *motion)
    tolerance = rounding(expected)
    for name, value in load(cell, *motion).items():
        np.testing.assert_allclose(
            value, expected[name], atol=tolerance, rtol=tolerance, err_msg=name
        )


@given(seed=st.integers(0, 2**31))
def test_contact_forces_and_gravity_move_the_box_as_newton_and_euler_say(seed: int) -> None:
    """Balance recomputed from the motion of the centre of mass, itself differentiated in time."""
    rng = np.random.default_rng(seed)
    cell, (pose, rate, second) = random_cell(rng), random_motion(rng)
    payload, result = cell.payload, load(cell, pose, rate, second)

    def centre_of_mass(t: float) -> Array:
        at = pose + rate * t + second * t**2 / 2.0
        return at[:3] + rotation(at[3:]) @ payload.centre_of_mass

    h = 1e-4
    acceleration = (centre_of_mass(h) - 2 * centre_of_mass(0.0) + centre_of_mass(-h)) / h**2
    forces = result["contact_force"].reshape(2, 3)
    weight = payload.mass * np.array([0.0, 0.0, -9.81])
    assert forces.sum(axis=0) + weight == pytest.approx(payload.mass * acceleration, abs=1e-4)

    # The same balance to rounding, with the acceleration from axes carried round.
    force, moment, c = needed(cell, pose, rate, second)
    assert np.abs(forces.sum(axis=0) - force).max() < 1e-9
    shifts, R = result["shift_vector"].reshape(2, 3), rotation(pose[3:])
    exerted = sum(
        np.cross(R @ contact.T_box_pad[:3, 3] + shifts[i] - c, forces[i])
        for i, contact in enumerate(cell.contacts)
    )
    assert exerted + result["moment_residual"] == pytest.approx(moment, abs=1e-9)


BRANCHES = ("both cones tight", "2 unloaded", "1 unloaded", "cone 2 tight", "cone 1 tight")
CASES = 800


def _allocation() -> ca.Function:
    force, normal, mu = ca.SX.sym("force", 3), ca.SX.sym("normal", 3), ca.SX.sym("mu", 2)
    result = allocate(force, normal, (mu[0], mu[1]))
    outputs = [*result[:2], *result[2]]
    return ca.Function(
        "allocation",
        [force, normal, mu],
        outputs,
        ["force", "normal", "mu"],
        ["normal_force", "tangential_force", "force_1", "force_2"],
    )


ALLOCATION = _allocation()


def least_effort_forces(force: Array, normal: Array, mu: Array) -> tuple[Array, Array]:
    """Both forces from a second-order cone program in all six components."""
    helper = np.eye(3)[np.argmin(np.abs(normal))]
    a = np.cross(normal, helper)
    a /= np.linalg.norm(a)
    b, none = np.cross(normal, a), np.zeros((3, 3))
    cone_1 = np.hstack([np.vstack([mu[0] * normal, a, b]), none])
    cone_2 = np.hstack([none, np.vstack([-mu[1] * normal, a, b])])
    balance = np.hstack([np.eye(3), np.eye(3)])
    cones = [(-rows, np.zeros(3), [clarabel.SecondOrderConeT(3)]) for rows in (cone_1, cone_2)]
    blocks = [(balance, force, [clarabel.ZeroConeT(3)]), *cones]
    found = solved(2.0 * np.eye(6), np.zeros(6), blocks)
    assert found is not None
    x = found
    # The status alone is not trusted: what came out has to be a feasible pair of forces.
    assert np.abs(balance @ x - force).max() < 1e-7
    for cone in (cone_1, cone_2):
        values = cone @ x
        assert np.hypot(values[1], values[2]) - values[0] < 1e-7
    return x[:3], x[3:]


def random_case(rng: np.random.Generator, equal: bool) -> tuple[Array, Array, Array]:
    """A unit force anywhere from along the normal to across it, a normal, two coefficients."""
    normal = rng.normal(size=3)
    normal /= np.linalg.norm(normal)
    across = np.cross(normal, rng.normal(size=3))
    across /= np.linalg.norm(across)
    tilt = rng.uniform(0.0, np.pi)
    force = np.cos(tilt) * normal + np.sin(tilt) * across
    mu = rng.uniform(0.1, 2.0, 2)
    return force, normal, np.full(2, mu[0]) if equal else mu


@pytest.mark.parametrize("equal", [True, False], ids=["equal friction", "unequal friction"])
def test_agrees_with_a_conic_solver_on_every_branch(equal: bool) -> None:
    rng = np.random.default_rng(7)
    hits = dict.fromkeys(BRANCHES, 0)
    worst_force, worst_effort = 0.0, 0.0
    for _ in range(CASES):
        force, normal, mu = random_case(rng, equal)
        ours = call(ALLOCATION, force, normal, mu)
        first, second = least_effort_forces(force, normal, mu)
        effort = float(ours["force_1"] @ ours["force_1"] + ours["force_2"] @ ours["force_2"])
        worst_effort = max(worst_effort, abs(effort - float(first @ first + second @ second)))
        error = np.abs([ours["force_1"] - first, ours["force_2"] - second]).max()
        worst_force = max(worst_force, float(error))
        f_n = float(force @ normal)
        f_t = float(np.linalg.norm(force - f_n * normal))
        values: Array = np.array(normal_force_branches(ca.DM(f_n), ca.DM(f_t), (mu[0], mu[1])))
        hits[BRANCHES[int(np.argmax(values))]] += 1
    assert worst_effort < 1e-8
    assert worst_force < 1e-6
    assert min(hits.values()) >= 10, hits


@given(f_n=st.floats(-200.0, 200.0), f_t=st.floats(0.01, 200.0), mu=st.floats(0.05, 3.0))
def test_equal_friction_gives_the_published_maximum_of_three(
    f_n: float, f_t: float, mu: float
) -> None:
    result = call(ALLOCATION, [f_t, 0.0, f_n], [0.0, 0.0, 1.0], [mu, mu])
    total = max(f_t / mu, abs(f_n), (mu * f_t + mu**2 * abs(f_n)) / (1.0 + mu**2))
    light = min(mu * (total - abs(f_n)) / 2.0, f_t / 2.0)
    assert result["normal_force"].sum() == pytest.approx(total, abs=1e-9, rel=1e-12)
    assert result["normal_force"][0] - result["normal_force"][1] == pytest.approx(f_n, abs=1e-9)
    lighter = 0 if f_n < 0.0 else 1
    assert result["tangential_force"][lighter] == pytest.approx(light, abs=1e-9, rel=1e-9)


@given(
    seed=st.integers(0, 2**31),
    size=st.floats(1.0, 500.0),
)
def test_balances_the_force_within_both_cones(seed: int, size: float) -> None:
    force, normal, mu = random_case(np.random.default_rng(seed), equal=False)
    force = size * force
    result = call(ALLOCATION, force, normal, mu)
    np.testing.assert_allclose(result["force_1"] + result["force_2"], force, atol=1e-9)
    for i, sign in ((0, 1.0), (1, -1.0)):
        contact = result[f"force_{i + 1}"]
        along = sign * float(contact @ normal)
        across = float(np.linalg.norm(contact - sign * along * normal))
        assert along >= -1e-9
        assert across <= mu[i] * along + 1e-9
        assert along == pytest.approx(result["normal_force"][i], abs=1e-9)
        assert across == pytest.approx(result["tangential_force"][i], abs=1e-8)


@pytest.mark.parametrize("along", [-50.0, 0.0, 50.0])
def test_derivatives_stay_finite_without_tangential_force(along: float) -> None:
    force = ca.SX.sym("force", 3)
    result = allocate(force, ca.DM([0, 0, 1]), (0.6, 0.9))
    jacobian = ca.jacobian(ca.vertcat(*result[2]), force)
    values = ca.Function("jacobian", [force], [jacobian])([0.0, 0.0, along])
    assert np.all(np.isfinite(values.full()))


# --- forces that carry moments as well ---


def needed(cell: Workcell, pose: Array, rate: Array, second: Array) -> tuple[Array, Array, Array]:
    """Force and moment about the centre of mass that a motion asks for, and the latter's place
    from the box centre; (3,) each, world frame."""
    R, payload = rotation(pose[3:]), cell.payload
    omega, alpha = angular_rates(pose[3:], rate[3:], second[3:])
    c = R @ payload.centre_of_mass
    acceleration = second[:3] + np.cross(alpha, c) + np.cross(omega, np.cross(omega, c))
    inertia = R @ payload.inertia @ R.T
    moment = inertia @ alpha + np.cross(omega, inertia @ omega)
    return payload.mass * (acceleration - PLAIN_GRAVITY), moment, c


def box_load(cell: Workcell, motion: tuple[Array, Array, Array]) -> Array:
    """(6,) force and moment about the box frame's origin that a motion asks for, box axes."""
    force, moment, c = needed(cell, *motion)
    R = rotation(motion[0][3:])
    return np.concatenate([R.T @ force, R.T @ (moment + np.cross(c, force))])


def even(cell: Workcell) -> Workcell:
    return with_task(cell, allocation="soft-finger")


@pytest.mark.parametrize(
    ("kinds", "count"),
    [
        (None, 20),
        pytest.param(("round", "rectangle"), 2, marks=pytest.mark.slow),
        (("rectangle", "round", "rectangle"), 2),
    ],
)
def test_pads_that_press_evenly_balance_the_motion(
    kinds: tuple[str, ...] | None, count: int
) -> None:
    """With as much effort as points of friction all over the patches need."""
    rng = np.random.default_rng(7)
    for _ in range(count):
        cell, motion = random_cell(rng), random_motion(rng)
        cell = random_grasp(rng, even(cell), kinds) if kinds else even(cell)
        found, asked = load(cell, *motion), box_load(cell, motion)
        size = float(np.abs(found["contact_force"]).max())
        friction = np.array([contact.friction for contact in cell.contacts])
        limit = friction * found["normal_force"] * (1.0 + 1e-9)
        assert (found["tangential_force"] <= limit).all()
        # Each robot's wrench about its first pad.
        R = rotation(motion[0][3:])
        total = np.zeros(6)
        for i, contact in enumerate(cell.contacts):
            wrench = found[f"wrench_{i + 1}"]
            force, turning = R.T @ wrench[:3], R.T @ wrench[3:]
            total += np.concatenate([force, turning + np.cross(contact.T_box_pad[:3, 3], force)])
        np.testing.assert_allclose(total, asked, atol=1e-6 * size)
        np.testing.assert_allclose(found["moment_residual"], 0.0, atol=1e-6 * size)
        forces = np.concatenate([found["wrench_1"][:3], found["wrench_2"][:3]])
        np.testing.assert_allclose(found["contact_force"], forces, atol=1e-12 * size)
        if kinds:
            expected = least_on_grids(cell.pads, asked)
            own = [np.array(cell.pad_robots) == i for i in (0, 1)]
            normal = [expected[pads, 2].sum() for pads in own]
            most = float(np.abs(expected[:, :3]).max())
            np.testing.assert_allclose(found["normal_force"], normal, atol=0.05 * most)
            np.testing.assert_allclose(found["pressure_shift"], 0.0, atol=1e-12)


@pytest.mark.parametrize("kinds", [None, ("round", "rectangle")])
def test_runs_in_lanes(kinds: tuple[str, ...] | None) -> None:
    """A batch is evaluated side by side only if every construct of the function is known there."""
    cell = ten_kilogram_cell()
    cell = random_grasp(np.random.default_rng(1), cell, kinds) if kinds else cell
    assert lane_text(generated_c([load_function(even(cell))]), "load") is not None


def test_squeezes_of_cases_agree_with_the_true_bodys_balance() -> None:
    """The body's inertia about its own centre of mass follows by Steiner's theorem."""
    rng = np.random.default_rng(11)
    for _ in range(40):
        cell, (pose, rate, second) = random_cell(rng), random_motion(rng)
        friction, radius = rng.uniform(0.3, 1.2, 2), np.full(2, np.nan)
        mass, disturbance = cell.payload.mass * rng.uniform(0.8, 1.2), rng.normal(size=3)
        centre = cell.payload.centre_of_mass + rng.normal(scale=0.01, size=3)
        displaced = rng.normal(scale=0.002, size=(2, 2))
        d = centre - cell.payload.centre_of_mass
        nominal = mass / cell.payload.mass * cell.payload.inertia
        inertia = nominal - mass * (d @ d * np.eye(3) - np.outer(d, d))
        true = with_payload(cell, mass=mass, centre_of_mass=centre, inertia=inertia)
        pushed = second + np.concatenate([disturbance, np.zeros(3)])
        force, moment, _ = needed(true, pose, rate, pushed)
        R_box_pad = cell.contacts[0].T_box_pad[:3, :3]
        points = np.array([contact.T_box_pad[:3, 3] for contact in cell.contacts])
        arms = (points - centre) @ R_box_pad
        arms[:, :2] += displaced
        to_pad = (rotation(pose[3:]) @ R_box_pad).T
        patch_1, patch_2 = (SoftPatch.of(contact, R_box_pad) for contact in cell.contacts)
        asked = ca.SX(to_pad @ force), ca.SX(to_pad @ moment)
        held = least_soft_squeeze(
            *asked,
            (ca.SX(arms[0]), ca.SX(arms[1])),
            ca.SX(friction),
            (patch_1, patch_2),
            offset=True,
        )
        expected = np.array(ca.evalf(held.normal)).ravel()
        case = np.concatenate([friction, radius, [mass], centre, disturbance, displaced.ravel()])
        case = np.append(case, np.zeros(CASE_SIZE - len(case)))  # pads press as commanded
        found = call(case_squeeze_function(cell), pose, rate, second, case)["normal_force"]
        np.testing.assert_allclose(found, expected, rtol=1e-9)
