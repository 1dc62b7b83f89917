"""Forces on the central path: against clarabel, the paper, laws, and differences."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from symbolic.array import Array
from symbolic.contact.grasp import Grasp
from symbolic.contact.paper import normal_force_branches
from symbolic.contact.soft_grasp import SoftGrasp
from symbolic.records import Workcell
from tests.symbolic.cells import hand_cell
from tests.symbolic.contact.grasp_oracle import least_wrenches, random_grasp, random_load

KINDS = (
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
    friction = np.array([contact.friction for contact in cell.contacts])
    program = SoftGrasp(Grasp(cell), friction, weight)
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
@pytest.mark.parametrize("kinds", KINDS)
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


def test_forces_tend_to_those_of_least_effort() -> None:
    kinds = ("rectangle", "rectangle")
    load = random_load(np.random.default_rng(8))
    exact = least_wrenches(grasp_of(kinds).pads, load)[:, 2]
    gaps = [
        np.abs(values(soft(kinds, weight)[0], load)[0] - exact).max()
        for weight in (1e-3, 1e-4, 1e-5, 1e-6)
    ]
    for wide, narrow in pairwise(gaps):
        assert narrow < 0.2 * wide


@pytest.mark.parametrize("kinds", KINDS)
def test_gradients_tend_to_those_of_least_effort(kinds: tuple[str, ...]) -> None:
    """Against differences of clarabel's forces, at loads away from kinks."""
    cell, rng = grasp_of(kinds), np.random.default_rng(6)
    first, _ = soft(kinds, 1e-7)

    def least(load: Array) -> Array:
        wrenches = least_wrenches(cell.pads, load)
        return np.bincount(cell.pad_robots, wrenches[:, 2], 2).astype(float)

    for _ in range(3):
        load = random_load(rng)
        slope, step = values(first, load)[1], 1e-3 * float(np.linalg.norm(load))
        pairs = [(least(load + step * d), least(load - step * d)) for d in np.eye(6)]
        found = np.column_stack([(a - b) / (2.0 * step) for a, b in pairs])
        np.testing.assert_allclose(slope, found, atol=1e-3 * np.abs(slope).max())


@pytest.mark.parametrize("weight", [1e-5, 1e-3])
@pytest.mark.parametrize("kinds", KINDS)
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


@pytest.mark.parametrize("kinds", KINDS)
@given(seed=st.integers(0, 10**6), factor=st.floats(0.1, 20.0))
def test_forces_grow_with_the_load(kinds: tuple[str, ...], seed: int, factor: float) -> None:
    """Homogeneous of degree one: Euler's relations for values, gradients and second derivatives."""
    first, second = soft(kinds, 1e-4)
    load = random_load(np.random.default_rng(seed))
    normal, slope, state = values(first, load)
    bent = curvatures(second, state)
    more = values(first, factor * load)
    size = np.abs(normal).max()
    np.testing.assert_allclose(more[0], factor * normal, atol=1e-8 * factor * size)
    np.testing.assert_allclose(slope @ load, normal, atol=1e-8 * size)
    np.testing.assert_allclose(bent, bent.transpose(0, 2, 1), atol=1e-8 * np.abs(bent).max())
    by_load = np.abs(bent).max() * np.linalg.norm(load)
    np.testing.assert_allclose(bent @ load, 0.0, atol=1e-7 * by_load)


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
