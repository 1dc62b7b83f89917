"""What a patch carries: its cone, where the centre of pressure is, which pad layers give way."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import block_diag, eigh
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from symbolic.array import Array
from symbolic.contact.central_path import Patch
from symbolic.contact.elastic import SHEAR, free_shift, pressure_shifts
from symbolic.contact.force_closure import corner_modes
from symbolic.contact.paper import pressure_shift, required_moment
from symbolic.contact.rectangular_patch import RectangularPatch
from symbolic.contact.round_patch import RoundPatch, patch_slack
from symbolic.records import Workcell
from tests.symbolic.cells import call, hand_cell, solid_box

SIDES = (0.03, 0.02)
DISC, RECTANGLE = RoundPatch(), RectangularPatch(*SIDES)
STATES = {
    DISC: np.array([2.0, 0.3, -0.4, 0.5, 0.2, -0.1, 0.05]),
    RECTANGLE: np.array([4.0, 0.3, -0.4, 0.5, 0.2, -0.1, 0.1, 0.05, -0.1, 0.03, 0.02, 0.1]),
}
PAIRING = {DISC: 1.0, RECTANGLE: 0.5}
"""Of multipliers with a state, over the trace of the matrices' product."""


def disc_matrix(free: Array) -> Array:
    n, t_x, t_y, q_x, q_y, m, z = free
    q, t, c = q_x + 1j * q_y, t_x + 1j * t_y, z + 1j * m
    return np.array([[n, q.conj(), t.conj()], [q, n, c.conj()], [t, c, n]])


def matrix_of(patch: Patch, state: Array) -> Array:
    """X of a patch's whole state; linear."""
    if patch is DISC:
        return disc_matrix(state)
    corners = (corner_modes(SIDES) @ state).reshape(4, 3)
    return np.asarray(block_diag(*[[[n + x, y], [y, n - x]] for n, x, y in corners]))


def multipliers(patch: Patch, iterate: Array) -> Array:
    """S of an iterate."""
    own = iterate[len(STATES[patch]) :]
    if patch is DISC:
        d, (q, t) = own[:3], (own[3] + 1j * own[4], own[5] + 1j * own[6])
        c = np.complex128(1j * own[7])
        return np.array([[d[0], q.conj(), t.conj()], [q, d[1], c.conj()], [t, c, d[2]]])
    return np.asarray(block_diag(*[[[n + x, y], [y, n - x]] for n, x, y in own.reshape(4, 3)]))


def iterate_of(patch: Patch) -> Array:
    """An iterate off the central path: centred for another state."""
    state, weight = ca.SX.sym("state", len(STATES[patch]) - (patch is DISC)), 0.7
    centred = ca.Function("centred", [state], [patch.centred(state, weight)])
    own = STATES[patch][: state.shape[0]]
    found: Array = np.array(centred(own)).ravel()
    np.testing.assert_allclose(
        matrix_of(patch, found[: len(STATES[patch])]) @ multipliers(patch, found),
        weight * np.eye(len(matrix_of(patch, STATES[patch]))),
        atol=1e-12,
    )
    found[: len(STATES[patch])] = STATES[patch] * np.linspace(1.0, 1.1, len(STATES[patch]))
    return found


@pytest.mark.parametrize("patch", STATES, ids=["disc", "rectangle"])
def test_a_step_solves_its_equations(patch: Patch) -> None:
    """S + dS = weight / X - sym(X^-1 dX S); paired with a disc's z it is zero, as S is."""
    size, iterate = len(STATES[patch]), iterate_of(patch)
    symbol, change = ca.SX.sym("iterate", patch.iterate_size), ca.SX.sym("change", size)
    local = patch.local(symbol)
    aim = ca.SX(0.3), ca.SX.zeros(patch.correction_size)
    step = local.step(*aim, change)
    outputs = [local.gap, local.stiffness, local.pull(*aim), step.change, step.lowest_of_state]
    outputs += [step.lowest, step.second_order()]
    run, asked = ca.Function("run", [symbol, change], outputs), np.zeros(size)
    stiffness, pull = (np.array(value).squeeze() for value in run(iterate, asked)[1:3])
    asked = 0.1 * np.random.default_rng(0).normal(size=size)
    if patch is DISC:
        asked[6] = (pull[6] - stiffness[6, :6] @ asked[:6]) / stiffness[6, 6]
    gap, _, _, moved, of_state, of_both, second = [
        np.array(value).squeeze() for value in run(iterate, asked)
    ]
    np.testing.assert_allclose(moved[:size], asked)
    X, S = matrix_of(patch, iterate[:size]), multipliers(patch, iterate)
    dX, dS = matrix_of(patch, moved[:size]), multipliers(patch, moved)
    inverse, share = np.linalg.inv(X), PAIRING[patch]
    assert gap == pytest.approx(share * np.trace(X @ S).real)
    both = inverse @ dX @ S
    np.testing.assert_allclose(S + dS, 0.3 * inverse - (both + both.conj().T) / 2, atol=1e-12)
    units = [matrix_of(patch, unit) for unit in np.eye(size)]
    given = share * np.array([np.trace(A @ (S + dS)).real for A in units])
    np.testing.assert_allclose(given, pull - stiffness @ asked, atol=1e-12)
    exact = [float(eigh(change, of)[0].min()) for change, of in ((dX, X), (dS, S))]
    assert exact[0] - 1e-3 * abs(exact[0]) <= of_state <= exact[0] + 1e-12
    assert min(exact) - 1e-3 <= of_both <= min(exact) + 1e-12
    left_out = inverse @ dX @ dS
    whole = (left_out + left_out.conj().T) / 2
    if patch is DISC:
        np.testing.assert_allclose(second[:3], np.diag(whole).real, atol=1e-12)
        below = whole[[1, 2, 2], [0, 0, 1]]
        np.testing.assert_allclose(second[3::2] + 1j * second[4::2], below, atol=1e-12)
    else:
        blocks = [whole[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] for k in range(4)]
        rows = [[(b[0, 0] + b[1, 1]) / 2, (b[0, 0] - b[1, 1]) / 2, b[0, 1]] for b in blocks]
        np.testing.assert_allclose(second, np.ravel(rows), atol=1e-12)


_wrench = ca.SX.sym("wrench", 6)
SLACK = ca.Function("slack", [_wrench], [patch_slack(_wrench)])


def slack(wrench: Array) -> float:
    return float(SLACK(wrench))


def point_wrench(x: Array, force: Array) -> Array:
    """Scaled wrench (6,) of a unit normal force at x (2,) with friction `force` (2,)."""
    return np.array([1.0, *force, *x, x[0] * force[1] - x[1] * force[0]])


def on_disc(rng: np.random.Generator, n: int) -> Array:
    angle, radius = rng.uniform(0.0, 2.0 * np.pi, n), np.sqrt(rng.random(n))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def inner_wrench(rng: np.random.Generator) -> Array:
    """A wrench within the cone: some of several points' and a centred squeeze."""
    n = int(rng.integers(1, 5))
    points = [point_wrench(x, f) for x, f in zip(on_disc(rng, n), on_disc(rng, n), strict=True)]
    wrench: Array = rng.dirichlet(np.ones(n)) @ np.array(points) + 0.1 * np.eye(6)[0]
    return rng.uniform(1.0, 100.0) * wrench


@given(seed=st.integers(0, 2**31), n=st.integers(1, 8))
def test_whatever_pressure_with_coulomb_friction_lies_within(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    points = [point_wrench(x, f) for x, f in zip(on_disc(rng, n), on_disc(rng, n), strict=True)]
    wrench = rng.dirichlet(np.ones(n)) @ np.array(points)
    assert slack(wrench) >= -1e-12
    assert np.linalg.norm(wrench[1:3]) <= 1.0 + 1e-12
    assert np.linalg.norm(wrench[3:5]) <= 1.0 + 1e-12


@given(seed=st.integers(0, 2**31))
def test_reaches_as_far_as_pressures_do_in_every_direction(seed: int) -> None:
    """Largest c.d + a.T + b M over the cone by its formula, and over points on the disc."""
    rng = np.random.default_rng(seed)
    a, c, b = rng.normal(size=2), rng.normal(size=2), rng.normal()
    angle, radius = np.meshgrid(np.linspace(0.0, 2.0 * np.pi, 721), np.linspace(0.0, 1.0, 201))
    x = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)
    turned = np.stack([-x[..., 1], x[..., 0]], axis=-1)
    reach = np.linalg.norm(a + b * turned, axis=-1)
    by_points = (x @ c + reach).max()
    by_cone = (x @ c + np.sqrt(reach**2 + b**2 * (1.0 - radius**2))).max()
    assert by_cone == pytest.approx(by_points, rel=1e-4)


@given(seed=st.integers(0, 2**31))
def test_torsion_about_the_centre_of_pressure_follows_the_ellipse(seed: int) -> None:
    rng = np.random.default_rng(seed)
    d, tangent = on_disc(rng, 1)[0], on_disc(rng, 1)[0]
    torsion = np.sqrt((1.0 - tangent @ tangent) * (1.0 - d @ d))
    shifted = d[0] * tangent[1] - d[1] * tangent[0]
    for sign in (1.0, -1.0):
        boundary = np.array([1.0, *tangent, *d, shifted + sign * torsion])
        assert slack(boundary) == pytest.approx(0.0, abs=1e-12)
        boundary[5] += 0.01 * sign
        assert slack(boundary) < 0.0


def barrier(wrench: Array) -> float:
    """-log det of the matrix whose determinant is largest over z, up to a constant."""
    bound = float(wrench[0])

    def minus_determinant(z: float) -> float:
        values = np.linalg.eigvalsh(disc_matrix(np.append(wrench, z)))
        return -float(values.prod()) if values[0] > 0.0 else -float(values[0] * bound**2)

    best = minimize_scalar(minus_determinant, bounds=(-bound, bound), options={"xatol": 1e-12})
    return -float(np.log(-best.fun))


def barrier_of(patch: Patch) -> ca.Function:
    """A state to the barrier's gradient and Hessian."""
    state = ca.SX.sym("state", patch.state_size)
    return ca.Function("barrier", [state], [*patch.barrier(state)])


BARRIERS = {patch: barrier_of(patch) for patch in STATES}


def test_the_barrier_of_a_rectangle_is_its_potentials() -> None:
    state = ca.SX.sym("state", 12)
    derived = ca.Function("derived", [state], [*Patch.barrier(RECTANGLE, state)])
    found, expected = (f(STATES[RECTANGLE]) for f in (BARRIERS[RECTANGLE], derived))
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-13)


@given(seed=st.integers(0, 2**31))
def test_barrier_is_the_determinants(seed: int) -> None:
    rng = np.random.default_rng(seed)
    wrench = inner_wrench(rng)
    wrench /= wrench[0]
    gradient, hessian = (np.array(v) for v in BARRIERS[DISC](wrench))
    h = 1e-4
    size = max(1.0, float(np.abs(gradient).max()), float(np.abs(hessian).max()))
    for direction in np.eye(6):
        before, here, after = (barrier(wrench + k * h * direction) for k in (-1.0, 0.0, 1.0))
        assert (after - before) / (2 * h) == pytest.approx(
            float(direction @ gradient[:, 0]), abs=1e-4 * size
        )
        assert (after - 2.0 * here + before) / h**2 == pytest.approx(
            float(direction @ hessian @ direction), abs=1e-3 * size
        )


def _shift() -> ca.Function:
    names = ("moment", "arm_1", "arm_2", "force_1", "force_2", "tangent_1", "tangent_2")
    moment, *pairs = symbols = [ca.SX.sym(name, 3) for name in names]
    arms, forces, tangents = (tuple(pairs[k : k + 2]) for k in (0, 2, 4))
    shifts, point, residual = pressure_shift(moment, arms, forces, tangents)
    outputs = ["shift_1", "shift_2", "point_residual", "residual"]
    return ca.Function("shift", symbols, [*shifts, point, residual], list(names), outputs)


SHIFT = _shift()


def random_case(seed: int) -> tuple[list[Array], Array]:
    """Inputs of `SHIFT` for two opposite pads that press and carry, and the contact normal."""
    rng = np.random.default_rng(seed)
    R = Rotation.random(rng=rng).as_matrix()
    normal = R[:, 2]
    presses = rng.uniform(20.0, 150.0, 2)
    forces = [
        sign * press * normal + R[:, :2] @ rng.normal(scale=40.0, size=2)
        for sign, press in zip((1.0, -1.0), presses, strict=True)
    ]
    arms = [-0.2 * normal + rng.normal(scale=0.03, size=3), 0.2 * normal]
    return [rng.normal(scale=3.0, size=3), *arms, *forces, R[:, 0], R[:, 1]], normal


def lever(inputs: list[Array]) -> Array:
    _, _, _, *forces, a, b = inputs
    return np.column_stack([np.cross(t, f) for f in forces for t in (a, b)])


@given(seed=st.integers(0, 2**31))
def test_agrees_with_the_pseudo_inverse(seed: int) -> None:
    inputs, _ = random_case(seed)
    moment, arm_1, arm_2, force_1, force_2, a, b = inputs
    missing = moment - np.cross(arm_1, force_1) - np.cross(arm_2, force_2)
    A = lever(inputs)
    d = np.linalg.pinv(A) @ missing
    plane = np.column_stack([a, b])
    result = call(SHIFT, *inputs)
    # The damping of 1e-12 relative counts by the square of the condition number.
    tolerance = 1e-11 * np.linalg.cond(A) ** 2 * max(1.0, float(np.abs(d).max()))
    np.testing.assert_allclose(result["point_residual"], missing, atol=1e-12)
    np.testing.assert_allclose(result["shift_1"], plane @ d[:2], atol=tolerance)
    np.testing.assert_allclose(result["shift_2"], plane @ d[2:], atol=tolerance)


def test_pure_squeeze_leaves_the_moment_about_its_axis() -> None:
    """Without tangential force no shift turns the box about the normal: that part remains."""
    missing = np.array([1.0, 2.0, 3.0])
    z = np.eye(3)[2]
    inputs = [missing, -0.2 * z, 0.2 * z, 80.0 * z, -80.0 * z, np.eye(3)[0], np.eye(3)[1]]
    result = call(SHIFT, *inputs)
    np.testing.assert_allclose(result["residual"], [0.0, 0.0, 3.0], atol=1e-9)
    d = np.linalg.pinv(lever(inputs), rcond=1e-6) @ missing
    np.testing.assert_allclose([*result["shift_1"][:2], *result["shift_2"][:2]], d, atol=1e-11)


def test_without_forces_nothing_is_carried() -> None:
    zero = np.zeros(3)
    result = call(SHIFT, [0.1, 0.2, 0.3], zero, zero, zero, zero, [1, 0, 0], [0, 1, 0])
    np.testing.assert_allclose(result["residual"], [0.1, 0.2, 0.3])
    assert not result["shift_1"].any()


@given(seed=st.integers(0, 2**31))
def test_required_moment_is_the_rate_of_angular_momentum(seed: int) -> None:
    """Finite difference of R I R^T omega along a rotation with constant angular acceleration."""
    rng = np.random.default_rng(seed)
    R0 = Rotation.random(rng=rng)
    omega, alpha = rng.normal(size=3), rng.normal(size=3)
    inertia = solid_box(10.0, [0.3, 0.4, 0.25]) + 0.01 * np.ones((3, 3))
    h = 1e-5

    def momentum(t: float) -> Array:
        R = (Rotation.from_rotvec(omega * t + alpha * t**2 / 2.0) * R0).as_matrix()
        value: Array = R @ inertia @ R.T @ (omega + alpha * t)
        return value

    ours: Array = np.array(
        required_moment(ca.DM(inertia), ca.DM(R0.as_matrix()), ca.DM(omega), ca.DM(alpha))
    )[:, 0]
    assert ours == pytest.approx((momentum(h) - momentum(-h)) / (2 * h), abs=1e-7)


NORMAL = np.array([[60.0, 60.0]])


def apart(cell: Workcell) -> float:
    first, second = (contact.T_box_pad[:3, 3] for contact in cell.contacts)
    return float(np.linalg.norm(first - second))


def level(cell: Workcell) -> Workcell:
    """Pads at the height of the box frame's origin."""
    contacts = []
    for contact in cell.contacts:
        T = contact.T_box_pad.copy()
        T[[0, 2], 3] = 0.0
        contacts.append(replace(contact, T_box_pad=T))
    return replace(cell, contacts=(contacts[0], contacts[1]))


def test_forces_through_the_middle_shift_nothing() -> None:
    load = np.array([[20.0, 5.0, 98.1, 0.0, 0.0, 0.0]])
    assert pressure_shifts(level(hand_cell()), load, NORMAL).max() < 1e-12


def test_two_discs_bear_a_moment_across_mostly_by_opposed_tangential_forces() -> None:
    """Turned by an angle, each pad gives shear times half the distance, and its own bending
    stiffness, a quarter of its radius squared for a unit of its area."""
    cell, moment = level(hand_cell()), 3.0
    radius = cell.contacts[0].patch_radius
    bending, opposed = radius**2 / 4.0, SHEAR * apart(cell) ** 2 / 4.0
    per_pad = moment / 2.0 * bending / (bending + opposed)
    expected = per_pad / NORMAL[0, 0] / (radius / 4.0)
    found = pressure_shifts(cell, np.array([[0, 0, 0, moment, 0, 0]]), NORMAL)
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    assert found.max() < 0.2  # a few per cent of the radius, as simulated pads show


@pytest.mark.parametrize("sides", [(0.03, 0.01), (0.01, 0.03)])
def test_a_rectangle_lifts_off_at_a_third_of_its_half_side(sides: tuple[float, float]) -> None:
    cell = level(hand_cell())
    first, second = (
        replace(contact, half_sides=sides, patch_radius=float(np.hypot(*sides)))
        for contact in cell.contacts
    )
    cell = replace(cell, contacts=(first, second))
    axis = cell.contacts[0].T_box_pad[:3, 0]  # along x of the pads: bends them along y
    load = np.concatenate([np.zeros(3), 3.0 * axis])[None]
    bending, opposed = sides[1] ** 2 / 3.0, SHEAR * apart(cell) ** 2 / 4.0
    expected = 1.5 * bending / (bending + opposed) / NORMAL[0, 0] / (sides[1] / 3.0)
    np.testing.assert_allclose(pressure_shifts(cell, load, NORMAL), expected, rtol=1e-9)
    assert free_shift(first) == pytest.approx(0.01 / 3.0)
