"""The shipped cell whose load lies to one side: what only pressing harder can hold."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hybrid_opt.cell import Cell
from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.timing import TimingLimits
from hybrid_opt.timing.solve import time_path
from symbolic.read.cell import load
from tests.hybrid_opt.cells import shipped
from tests.symbolic.cells import ROOT

# Its functions are compiled for these tests alone.
pytestmark = pytest.mark.slow

UNEVEN = ROOT / "studies" / "workcells" / "uneven.toml"


@pytest.fixture(scope="module")
def cell() -> Cell:
    return shipped("uneven")


def test_only_the_joint_allocation_holds_it(cell: Cell, tmp_path: Path) -> None:
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


def test_it_is_certified_and_drivable_and_pads_hold_it(cell: Cell) -> None:
    """Free of collisions between samples, timed within every limit, and simulated."""
    assert cell.certify(cell.initial).is_free
    timing = time_path(cell.timing_model, cell.initial, TimingLimits(reference_speed=True))
    assert timing.ok
    assert timing.carry is not None
    pytest.importorskip("mujoco")
    from tests.hybrid_opt.witness.carries import assert_driven_pads_hold

    assert_driven_pads_hold(cell, timing.carry)
