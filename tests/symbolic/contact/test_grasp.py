"""The program of pads anywhere: where it starts, its derivatives, commanded forces."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from symbolic.array import Array
from symbolic.contact.central_path import START_WEIGHT
from symbolic.contact.force_closure import has_force_closure, smaller_patches, state_to_box
from symbolic.contact.grasp import REST_WEIGHT, Grasp
from symbolic.contact.grasp_squeeze import (
    OTHER_WEIGHT,
    GraspSqueeze,
    commanded_forces,
    commanded_slack,
)
from symbolic.contact.soft_grasp import SoftGrasp
from symbolic.errors import SettingsError
from symbolic.records import Contact, Workcell
from tests.refusals import refused
from tests.symbolic.contact.oracle import (
    effort,
    friction_of,
    function_of,
    least_on_grids,
    random_grasp,
    random_load,
    wrenches,
)
from tests.symbolic.contact.test_even_grasp import KINDS, even_cell


def on_adjacent_faces(mu: float) -> Workcell:
    """Pads of 1 mm radius as far from the edge."""
    contacts = []
    for place in np.eye(3)[:2]:
        x = np.cross(-place, [0.3, 0.5, 0.8])
        x /= np.linalg.norm(x)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = np.column_stack([x, np.cross(-place, x), -place]), 0.1 * place
        contacts.append(Contact(T, mu, 1e-3))
    return replace(even_cell(), contacts=(contacts[0], contacts[1]))


def test_adjacent_faces_hold_where_both_cones_reach_across_the_edge() -> None:
    """The line between points as far from the edge lies at 45 degrees to both faces: friction
    above one, of which closure takes three quarters and spares five percent."""
    with refused(SettingsError, "no-grasp"):
        Grasp(on_adjacent_faces(1.02))
    # Friction alone pulls away from the edge: 10 N + N_1 is mu N_2, 9 N + N_2 at most mu N_1.
    found = wrenches(on_adjacent_faces(1.45), np.array([10.0, 9.0, 0.0, 0.0, 0.0, 0.0]))
    np.testing.assert_allclose(found[:, 2], [10.0 / 0.45, 10.0 / 0.45 + 1.0], rtol=1e-4)


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
    cell = random_grasp(rng, even_cell(), kinds)
    upright = np.array([0.0, 0.0, 1.0])
    at_rest = np.concatenate([upright, np.cross(cell.payload.centre_of_mass, upright)])
    grasp = Grasp(cell)
    load, friction = ca.SX.sym("load", 6), ca.SX.sym("friction", 2)
    states, weight = grasp.start([load, friction])
    outputs = [patch.slack(state) for patch, state in zip(grasp.patches, states, strict=True)]
    outputs += [weight, grasp.effort(states, [load, friction])]
    start = ca.Function("start", [load, friction], [ca.vertcat(*outputs), *states])
    maps = [state_to_box(pad) for pad in cell.pads]
    disturbed = [0.05 * rng.normal(size=6) * [1, 1, 1, 0.1, 0.1, 0.1] for _ in range(8)]
    for asked in [at_rest, -at_rest, *[sign * at_rest + d for d in disturbed for sign in (1, -1)]]:
        found, *own = (np.array(v).ravel() for v in start(asked, friction_of(cell)))
        assert found[:-2].min() > 0.0
        balance = sum(A @ state for A, state in zip(maps, own, strict=True))
        np.testing.assert_allclose(balance, asked, atol=1e-9)
        if asked is at_rest:
            least = effort(wrenches(cell, asked)) / 2.0
            assert least < found[-1] < least * (1.0 + 1.5 * REST_WEIGHT)
            assert found[-2] < START_WEIGHT


# --- on the central path ---


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


@pytest.mark.parametrize("weight", [1e-5])
@pytest.mark.parametrize("kinds", KINDS[:3])
def test_derivatives_are_those_of_differences(kinds: tuple[str, ...], weight: float) -> None:
    first, second = functions_of(random_grasp(np.random.default_rng(3), even_cell(), kinds), weight)
    rng = np.random.default_rng(2)
    for _ in range(2):
        load = random_load(rng)
        _, slope, state = values(first, load)
        bent = curvatures(second, state)
        # Differences of states, which are known to the last digits over the weight.
        step = 1e-5 * float(np.linalg.norm(load))
        one, two = (differences(first, load, h) for h in (step, 2.0 * step))
        of_values, of_slopes = ((4.0 * a - b) / 3.0 for a, b in zip(one, two, strict=True))
        np.testing.assert_allclose(slope, of_values, atol=1e-5 * np.abs(slope).max())
        scale = max(np.abs(bent).max(), np.abs(slope).max() / np.linalg.norm(load))
        np.testing.assert_allclose(bent, of_slopes, atol=2e-3 * scale)


def differences(first: ca.Function, load: Array, step: float) -> tuple[Array, Array]:
    """(2, 6) and (2, 6, 6) of forces and of their gradients, to second order in the step."""
    pairs = [
        (values(first, load + step * d), values(first, load - step * d)) for d in np.eye(len(load))
    ]
    of_values = np.column_stack([(a[0] - b[0]) / (2.0 * step) for a, b in pairs])
    of_slopes = np.stack([(a[1] - b[1]) / (2.0 * step) for a, b in pairs], axis=-1)
    return of_values, of_slopes


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
        smaller_patches(cell := random_grasp(rng, even_cell(), kinds), 0.8)
    ):
        pass
    return cell


@pytest.mark.parametrize("kinds", KINDS[:2])
def test_squeezes_agree_with_grids_and_what_a_quick_look_holds_needs_no_more(
    kinds: tuple[str, ...],
) -> None:
    rng, known_to_hold = np.random.default_rng(5), 0
    for commanded in (0, 1):
        cell = closed_grasp(rng, kinds)
        function, look = squeeze_of(cell, commanded)
        weights = np.where(np.array(cell.pad_robots) == commanded, 1.0, OTHER_WEIGHT)
        for share in (1.0, 0.8)[commanded:]:
            load, small = random_load(rng), smaller_patches(cell, share)
            known = load, friction_of(cell), [share, share]
            found = np.array(function(*known)).ravel()
            expected = weights @ least_on_grids(small.pads, load, normal_weights=weights)[:, 2]
            # Next to nothing may have to be commanded.
            rounding = 4e-6 * float(np.linalg.norm(load[:3]))
            assert 0.985 * expected - rounding < found[commanded] < 1.04 * expected + rounding
            assert found[1 - commanded] > 0.0
            assert float(look(*known, 0.99 * found[commanded])) <= 0.0
            known_to_hold += float(look(*known, 10.0 * found[commanded])) > 0.0
    assert known_to_hold >= 2
