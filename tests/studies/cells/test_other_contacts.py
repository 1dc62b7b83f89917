"""The shipped cells whose pads are not two round opposite ones: a drum, and a crate on a fork."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hybrid_opt.cell import Cell
from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.evaluate.objectives import ROBUST_OBJECTIVES
from hybrid_opt.polishing.polisher import Polisher
from hybrid_opt.polishing.settings import PolishSettings
from hybrid_opt.robust.force import BoxMotion, RobustModel
from hybrid_opt.robust.path_force import RobustPath
from hybrid_opt.timing import TimingLimits, TimingModel
from hybrid_opt.timing.solve import time_path
from studies.research.plain.collisions import PlainCollisionChecker
from symbolic.contact.load import load_function
from symbolic.errors import SettingsError
from symbolic.read.cell import load
from symbolic.records import Uncertainty
from tests.hybrid_opt.cells import shipped
from tests.symbolic.cells import ROOT, call

WORKCELLS = ROOT / "studies" / "workcells"
PADS = {"drum": 2, "fork": 3}
"""How many pads hold it."""


@pytest.fixture(scope="module", params=list(PADS))
def cell(request: pytest.FixtureRequest) -> Cell:
    return shipped(request.param)


@pytest.mark.slow
def test_its_carry_is_feasible_certified_and_drivable_and_pads_hold_it(cell: Cell) -> None:
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
    for limits in (TimingLimits(reference_speed=True), TimingLimits(force=80.0)):
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
