"""The closed-form allocation against a conic solver, its optimality and its cones."""

from __future__ import annotations

import casadi as ca
import clarabel
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import sparse

from studies.research.plain.load import allocate as plain_allocate
from symbolic.array import Array
from symbolic.contact.paper import allocate, normal_force_branches, required_force
from tests.symbolic.cells import call

BRANCHES = ("both cones tight", "2 unloaded", "1 unloaded", "cone 2 tight", "cone 1 tight")
CASES = 1500


def _allocation() -> ca.Function:
    force, normal, mu = ca.SX.sym("force", 3), ca.SX.sym("normal", 3), ca.SX.sym("mu", 2)
    result = allocate(force, normal, (mu[0], mu[1]))
    outputs = [result.normal, result.tangential, result.force_1, result.force_2]
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
    b = np.cross(normal, a)
    cone_1 = np.hstack([np.vstack([mu[0] * normal, a, b]), np.zeros((3, 3))])
    cone_2 = np.hstack([np.zeros((3, 3)), np.vstack([-mu[1] * normal, a, b])])
    balance = np.hstack([np.eye(3), np.eye(3)])
    A = sparse.csc_matrix(np.vstack([balance, -cone_1, -cone_2]))
    right = np.concatenate([force, np.zeros(6)])
    cones = [
        clarabel.ZeroConeT(3),
        clarabel.SecondOrderConeT(3),
        clarabel.SecondOrderConeT(3),
    ]
    options = clarabel.DefaultSettings()
    options.verbose = False
    options.tol_gap_abs = options.tol_gap_rel = options.tol_feas = 1e-11
    P = sparse.csc_matrix(2.0 * np.eye(6))
    solution = clarabel.DefaultSolver(P, np.zeros(6), A, right, cones, options).solve()
    x = np.array(solution.x)
    assert str(solution.status) == "Solved"
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
    assert min(hits.values()) >= 20, hits


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


@given(seed=st.integers(0, 2**31))
def test_no_other_admissible_pair_of_forces_is_smaller(seed: int) -> None:
    """Random internal forces are added; those that keep both cones cost more."""
    rng = np.random.default_rng(seed)
    force, normal, mu = random_case(rng, equal=False)
    result = call(ALLOCATION, force, normal, mu)
    first, second = result["force_1"], result["force_2"]
    least = first @ first + second @ second
    for size in (1e-4, 1e-2, 1.0):
        for internal in size * rng.normal(size=(40, 3)):
            changed = (first + internal, second - internal)
            normals = (changed[0] @ normal, -(changed[1] @ normal))
            if all(
                np.linalg.norm(f - (f @ normal) * normal) <= coefficient * n
                for f, n, coefficient in zip(changed, normals, mu, strict=True)
            ):
                assert changed[0] @ changed[0] + changed[1] @ changed[1] >= least - 1e-12


@given(seed=st.integers(0, 2**31))
def test_exchanging_the_contacts_exchanges_the_forces(seed: int) -> None:
    force, normal, mu = random_case(np.random.default_rng(seed), equal=False)
    here, there = call(ALLOCATION, force, normal, mu), call(ALLOCATION, force, -normal, mu[::-1])
    np.testing.assert_allclose(here["force_1"], there["force_2"], atol=1e-12)
    np.testing.assert_allclose(here["normal_force"], there["normal_force"][::-1], atol=1e-12)


@given(seed=st.integers(0, 2**31))
def test_plain_reference_agrees_for_equal_and_unequal_friction(seed: int) -> None:
    rng = np.random.default_rng(seed)
    for equal in (True, False):
        force, normal, mu = random_case(rng, equal)
        f_n = float(force @ normal)
        f_t = float(np.linalg.norm(force - f_n * normal))
        n, t = plain_allocate(f_n, f_t, (mu[0], mu[1]))
        result = call(ALLOCATION, force, normal, mu)
        np.testing.assert_allclose(result["normal_force"], n, atol=1e-10)
        np.testing.assert_allclose(result["tangential_force"], t, atol=1e-9)


@pytest.mark.parametrize("along", [-50.0, 0.0, 50.0])
def test_derivatives_stay_finite_without_tangential_force(along: float) -> None:
    force = ca.SX.sym("force", 3)
    result = allocate(force, ca.DM([0, 0, 1]), (0.6, 0.9))
    jacobian = ca.jacobian(ca.vertcat(result.force_1, result.force_2), force)
    values = ca.Function("jacobian", [force], [jacobian])([0.0, 0.0, along])
    assert np.all(np.isfinite(values.full()))


def test_required_force_carries_the_weight_at_rest() -> None:
    force: Array = np.array(required_force(10.0, ca.DM([0.0, 0.0, 0.0])))[:, 0]
    np.testing.assert_allclose(force, [0.0, 0.0, 98.1])
