"""The shipped cells whose pads are not two round ones opposite in the middle: a drum, a crate on a
fork, pads on adjacent faces, and a load to one side, which only pressing harder can hold."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hybrid_opt.cell import Cell
from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.evaluate.objectives import ROBUST_OBJECTIVES
from hybrid_opt.polishing.polisher import Polisher
from hybrid_opt.polishing.settings import PolishSettings
from hybrid_opt.robust.force import BoxMotion, RobustModel
from hybrid_opt.robust.path_force import RobustPath
from hybrid_opt.timing.model import TimingModel
from hybrid_opt.timing.records import TimingLimits
from hybrid_opt.timing.solve import time_path
from studies.research.plain.collisions import PlainCollisionChecker
from symbolic.contact.load import load_function
from symbolic.errors import SettingsError
from symbolic.read.cell import load
from symbolic.records import Uncertainty
from tests.hybrid_opt.cells import shipped
from tests.symbolic.cells import ROOT, call

WORKCELLS = ROOT / "studies" / "workcells"
CORNER, UNEVEN = WORKCELLS / "corner.toml", WORKCELLS / "uneven.toml"
PADS = {"drum": 2, "fork": 3}
"""How many pads hold it."""

FORCE = {"drum": 80.0, "fork": 80.0, "corner": 30.0, "uneven": 117.0}
"""A limit within which it is driven [N]."""


@pytest.fixture(scope="module", params=list(PADS))
def cell(request: pytest.FixtureRequest) -> Cell:
    return shipped(request.param)


@pytest.mark.slow
@pytest.mark.parametrize("name", FORCE)
def test_its_carry_is_feasible_certified_and_drivable_and_pads_hold_it(name: str) -> None:
    cell = shipped(name)
    carry = cell.carry(cell.initial)
    assert carry.judgement is not None
    assert carry.judgement.feasible
    assert np.abs(carry.moment_residual).max() < 1e-9
    # Compiled, in lanes, against the interpreted function.
    load_of = load_function(cell.workcell)
    for k in (0, 30, 79):
        found = call(load_of, carry.pose[k], carry.rate[k], carry.second_rate[k])
        np.testing.assert_allclose(carry.normal_force[k], found["normal_force"], rtol=1e-9)
    # Collisions as FCL alone finds them.
    plain = PlainCollisionChecker(cell.workcell)
    joints = [arm.q for arm in carry.arms]
    assert not plain.check(carry.time, carry.pose, joints[0], joints[1]).colliding.any()
    assert cell.certify(cell.initial).is_free
    for limits in (TimingLimits(reference_speed=True), TimingLimits(force=FORCE[name])):
        timing = time_path(cell.timing_model, cell.initial, limits)
        assert timing.ok, timing.reason
        assert timing.carry is not None
        assert limits.force is None or timing.carry.normal_force.max() <= 1.003 * limits.force
    pytest.importorskip("mujoco")
    from tests.hybrid_opt.witness.carries import assert_driven_pads_hold

    slow = time_path(cell.timing_model, cell.initial, TimingLimits(reference_speed=True))
    assert slow.carry is not None
    assert_driven_pads_hold(cell, slow.carry)


@pytest.mark.slow
def test_robust_forces_keep_to_a_limit_and_hold_random_cases(cell: Cell) -> None:
    unsure = replace(cell.workcell, uncertainty=Uncertainty(0.08, 0.05, np.full(3, 0.004), 0.002))
    model, forces = TimingModel(unsure, 40), RobustModel(unsure)
    still = BoxMotion(
        *[np.tile(part, (1, 1)) for part in (unsure.task.waypoints[0].lower, *np.zeros((2, 6)))]
    )
    limit = 1.15 * float(forces.robust_force(still).peak.max())
    timing = time_path(model, cell.initial, TimingLimits(force=limit, robust=True))
    assert timing.ok, timing.reason
    assert timing.carry is not None
    force = forces.robust_force(timing.carry)
    assert 0.98 * limit <= force.peak.max() <= 1.005 * limit
    assert forces.check(timing.carry, force, 300, np.random.default_rng(1)).holds
    planned = time_path(model, cell.initial, TimingLimits(force=limit))
    assert planned.duration < timing.duration


@pytest.mark.slow
def test_what_knows_closed_forms_only_refuses_it(cell: Cell) -> None:
    unsure = replace(cell.workcell, uncertainty=Uncertainty(0.08, 0.05, np.full(3, 0.004), 0.002))
    with pytest.raises(SettingsError, match="face one another"):
        Polisher(CandidateEvaluator(unsure, ROBUST_OBJECTIVES), PolishSettings())
    with pytest.raises(SettingsError, match="face one another"):
        RobustPath(cell.workcell)


@pytest.mark.parametrize("name", list(PADS))
def test_it_is_read(name: str) -> None:
    workcell = load(WORKCELLS / f"{name}.toml")
    assert not workcell.has_opposite_pads
    assert len(workcell.pads) == PADS[name]


def test_at_rest_both_pads_hold_half_of_the_crate() -> None:
    """Across the edge the forces lie in the line of both pads, at 45 degrees to both normals."""
    workcell = load(CORNER)
    first, second = workcell.contacts
    assert abs(first.T_box_pad[:3, 2] @ second.T_box_pad[:3, 2]) < 1e-12
    still = np.zeros(6)
    found = call(load_function(workcell), still, still, still)
    one, two = found["contact_force"].reshape(2, 3)
    weight = 9.81 * workcell.payload.mass
    np.testing.assert_allclose(one + two, [0.0, 0.0, weight], atol=1e-9 * weight)
    np.testing.assert_allclose([one[2], two[2]], weight / 2.0, rtol=1e-4)
    np.testing.assert_allclose(found["normal_force"][0], found["normal_force"][1], rtol=1e-4)
    for contact, force in zip(workcell.contacts, (one, two), strict=True):
        normal = contact.T_box_pad[:3, 2]
        along = normal @ force
        assert np.linalg.norm(force - along * normal) <= contact.friction * along


def test_soft_fingers_need_more_but_hold_it_as_well() -> None:
    workcell = load(CORNER)
    even = replace(workcell, task=replace(workcell.task, allocation="soft-finger"))
    still = np.zeros(6)
    least, found = (call(load_function(cell), still, still, still) for cell in (workcell, even))
    assert (found["normal_force"] >= least["normal_force"] * (1.0 - 1e-4)).all()
    np.testing.assert_allclose(found["pressure_shift"], 0.0, atol=1e-9)
    np.testing.assert_allclose(found["moment_residual"], 0.0, atol=1e-6)


@pytest.mark.slow
def test_compiled_passes_agree_with_the_independent_timing() -> None:
    """Where a program finds the contact forces, within a force limit that decides."""
    cell = shipped("corner").drivable()
    path, limits = cell.initial[: cell.workcell.task.n_path], TimingLimits(force=30.0)
    assert cell.path_timer.compiled
    found = cell.path_timer.time(path, limits)
    other = time_path(TimingModel(cell.compiled, cell.path_timer.intervals), path, limits)
    assert found.ok
    assert found.duration == pytest.approx(other.duration, rel=5e-3)
    assert found.peak_force.max() == pytest.approx(30.0, rel=2e-3)


@pytest.mark.slow
def test_only_the_joint_allocation_holds_a_load_to_one_side(tmp_path: Path) -> None:
    cell = shipped("uneven")
    carry = cell.carry(cell.initial)
    assert carry.judgement is not None
    assert carry.judgement.feasible
    radius = cell.workcell.contacts[0].patch_radius
    assert carry.peak_pressure_shift == pytest.approx([radius, radius], rel=1e-3)
    assert np.abs(carry.moment_residual).max() < 1e-9
    text = UNEVEN.read_text(encoding="utf-8").replace('allocation = "joint"\n', "")
    path = tmp_path / "paper.toml"
    path.write_text(text.replace("../robots", str(UNEVEN.parents[1] / "robots")), encoding="utf-8")
    paper = CandidateEvaluator(load(path)).carry(cell.initial)
    assert paper.judgement is not None
    assert paper.judgement.reason.startswith("pressure")
    assert (carry.peak_normal_force > paper.peak_normal_force).all()
