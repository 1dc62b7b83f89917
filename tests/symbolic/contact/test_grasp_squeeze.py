"""Commanded forces of pads anywhere against clarabel, and what the quick look says."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from symbolic.contact.force_closure import has_force_closure
from symbolic.contact.worst_cases import (
    OTHER_WEIGHT,
    GraspSqueeze,
    commanded_forces,
    commanded_slack,
    smaller_patches,
)
from symbolic.records import Workcell
from tests.symbolic.cells import hand_cell
from tests.symbolic.contact.grasp_oracle import least_wrenches, random_grasp, random_load
from tests.symbolic.contact.test_grasp import KINDS, friction_of


def function_of(cell: Workcell, commanded: int) -> ca.Function:
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
def test_agrees_with_clarabel(kinds: tuple[str, ...], share: float) -> None:
    rng = np.random.default_rng(5)
    for commanded in (0, 1):
        cell = closed_grasp(rng, kinds)
        function, small = function_of(cell, commanded), smaller_patches(cell, share)
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
        function, squeeze = function_of(cell, 1), GraspSqueeze(cell, 1)
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
