"""Steps of both kinds of patch against their matrices, written out with NumPy."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import block_diag, eigh

from symbolic.array import Array
from symbolic.contact.force_closure import corner_modes
from symbolic.contact.patches import Patch
from symbolic.contact.rectangular_patch import RectangularPatch
from symbolic.contact.round_patch import RoundPatch

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
    """S + dS = weight / X - sym(X^-1 dX S), paired with everything but the wrench it is zero."""
    size, iterate = len(STATES[patch]), iterate_of(patch)
    symbol, change = ca.SX.sym("iterate", patch.iterate_size), ca.SX.sym("change", 6)
    local = patch.local(symbol)
    aim = local.aim(ca.SX(0.3), ca.SX.zeros(patch.correction_size))
    step = aim.step(change)
    outputs = [local.gap, local.stiffness, aim.pull, step.change, step.lowest_of_state]
    outputs += [step.lowest, step.second_order]
    asked = 0.1 * np.random.default_rng(0).normal(size=6)
    run = ca.Function("run", [symbol, change], outputs)
    gap, stiffness, pull, moved, of_state, of_both, second = [
        np.array(value).squeeze() for value in run(iterate, asked)
    ]
    np.testing.assert_allclose(moved[:6], asked)
    X, S = matrix_of(patch, iterate[:size]), multipliers(patch, iterate)
    dX, dS = matrix_of(patch, moved[:size]), multipliers(patch, moved)
    inverse, share = np.linalg.inv(X), PAIRING[patch]
    assert gap == pytest.approx(share * np.trace(X @ S).real)
    both = inverse @ dX @ S
    np.testing.assert_allclose(S + dS, 0.3 * inverse - (both + both.conj().T) / 2, atol=1e-12)
    units = [matrix_of(patch, unit) for unit in np.eye(size)]
    given = share * np.array([np.trace(A @ (S + dS)).real for A in units])
    np.testing.assert_allclose(given[:6], pull - stiffness @ asked, atol=1e-12)
    np.testing.assert_allclose(given[6:], 0.0, atol=1e-12)
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
