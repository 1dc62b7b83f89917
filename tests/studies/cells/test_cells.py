"""The cells that ship whose pads are not two round ones opposite in the middle, and those with
redundant joints; and a robot as people have it, beside the same cell written plainly."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from hybrid_opt.carry import BoxMotion
from hybrid_opt.cell import Cell
from hybrid_opt.evaluate.evaluation import REASONS, CandidateEvaluator, LockedEvaluator
from hybrid_opt.evaluate.objectives import ROBUST_OBJECTIVES
from hybrid_opt.polishing.polisher import make_polisher
from hybrid_opt.polishing.settings import PolishSettings
from hybrid_opt.robust.force import RobustModel
from hybrid_opt.robust.path_force import RobustPath
from hybrid_opt.timing.model import TimingModel
from hybrid_opt.timing.records import TimingLimits
from hybrid_opt.timing.solve import time_by_programs, time_path
from studies.programs.inspection import inspected
from studies.research.locked_joints import compare, locks
from studies.research.plain.collisions import PlainCollisionChecker
from studies.run import main
from symbolic.cell_model import CellModel, build_cell_model
from symbolic.contact.load import load_function
from symbolic.errors import SettingsError
from symbolic.functions import candidate_function
from symbolic.read.cell import load
from symbolic.records import Uncertainty
from tests.hybrid_opt.cells import shipped
from tests.odd_cells import SOURCES, described_cell, plain_cell
from tests.refusals import refused
from tests.symbolic.cells import RACK, ROOT, call, standing_text

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
    from tests.hybrid_opt.extras.simulation.carries import assert_driven_pads_hold

    slow = time_path(cell.timing_model, cell.initial, TimingLimits(reference_speed=True))
    assert slow.carry is not None
    assert_driven_pads_hold(cell, slow.carry)


UNSURE = Uncertainty(0.08, 0.05, np.full(3, 0.004), 0.002)


@pytest.mark.slow
def test_robust_forces_keep_to_a_limit_and_hold_random_cases(cell: Cell) -> None:
    unsure = replace(cell.workcell, uncertainty=UNSURE)
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
    unsure = replace(cell.workcell, uncertainty=UNSURE)
    with refused(SettingsError, "not-polishable"):
        make_polisher(CandidateEvaluator(unsure, ROBUST_OBJECTIVES), PolishSettings())
    with pytest.raises(SettingsError, match="opposite"):
        RobustPath(cell.workcell)


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


@pytest.mark.slow
def test_compiled_passes_agree_with_the_independent_timing() -> None:
    """Where a program finds the contact forces, within a force limit that decides."""
    cell = shipped("corner").drivable()
    path, limits = cell.initial[: cell.workcell.task.n_path], TimingLimits(force=30.0)
    assert cell.path_timer.passes.supports(limits)
    found = cell.path_timer.time(path, limits)
    model = TimingModel(cell.compiled, cell.path_timer.intervals)
    other = time_by_programs(model, model.path_motion(path), limits)
    assert found.ok
    assert found.duration == pytest.approx(other.duration, rel=5e-3)
    assert found.peak_force.max() == pytest.approx(30.0, rel=2e-3)


@pytest.mark.slow
def test_pressing_harder_holds_a_load_to_one_side(tmp_path: Path) -> None:
    cell = shipped("uneven")
    carry = cell.carry(cell.initial)
    assert carry.judgement is not None
    assert carry.judgement.feasible
    assert np.abs(carry.moment_residual).max() < 1e-6
    path, stated = tmp_path / "paper.toml", 'allocation = "soft-finger"\n'
    path.write_text(standing_text(UNEVEN).replace(stated, ""), encoding="utf-8")
    paper = CandidateEvaluator(load(path)).carry(cell.initial)
    assert paper.judgement is not None
    assert paper.judgement.reason.startswith("pressure")
    assert (carry.peak_normal_force > paper.peak_normal_force).all()


@pytest.mark.slow
def test_constant_elbows_ask_for_another_path_of_the_box() -> None:
    cell = shipped("pandas")
    x = cell.initial[None, : cell.workcell.task.n_box]
    tried = [LockedEvaluator(cell.evaluator, np.array(p)) for p in locks(cell.workcell.task, 16)]
    assert not any(one.evaluate(x).feasible.all() for one in tried)
    others = cell.random(400, np.random.default_rng(1))[:, : cell.workcell.task.n_box]
    assert 2 <= sum(one.evaluate(others).feasible.any() for one in tried) <= 8


@pytest.mark.slow
def test_elbows_that_move_beat_the_best_lock() -> None:
    (found,) = compare(shipped("pandas"), 16, 1, 300, 1)
    assert found.free > max(found.locked) > 0.3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "drawn", "seed"), [("rack", 20_000, 0), ("pandas", 1000, 1), ("tiago", 1000, 1)]
)
def test_the_hand_made_trajectory_is_feasible_and_few_random_ones_are(
    name: str, drawn: int, seed: int
) -> None:
    """Of the rack 2.01 % were feasible with this seed when the bounds were chosen."""
    judged = shipped(name)
    hand_made = judged.evaluate(judged.initial)
    assert judged.evaluator.certified(hand_made).feasible.all()
    found = judged.evaluate(judged.random(drawn, np.random.default_rng(seed)))
    assert 0.02 <= found.feasible.mean() <= 0.2
    if name == "rack":
        # 2.9 % above the static hold, the figure of a trial by another program.
        static = judged.workcell.payload.mass * 9.81 / 2.0
        excess = hand_made.objectives[0] * judged.workcell.task.reference_force / static - 1.0
        np.testing.assert_allclose(excess, 0.029, atol=5e-4)
        violated = {REASONS[k] for k in np.flatnonzero((found.violation > 0.0).any(axis=0))}
        assert {"collision", "reach_1", "reach_2", "joint_limits_1", "pressure_1"} <= violated


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pandas", "tiago"])
def test_a_small_study_goes_through(name: str, tmp_path: Path) -> None:
    output = tmp_path / "results"
    arguments = [str(RACK.with_name(f"{name}.toml")), "--output", str(output), "--replicas", "1"]
    arguments += ["--evaluations", "120", "--no-polish", "--no-report", "--no-drivable"]
    assert main([*arguments, "--jobs", "1", "--quiet"]) == 0
    assert (output / "summary.json").exists()


@pytest.fixture(scope="module")
def described(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cell]:
    folder = tmp_path_factory.mktemp("described")
    with pytest.MonkeyPatch.context() as patch:
        for variable, name in zip(SOURCES, ("ament", "ros"), strict=True):
            patch.setenv(variable, str(folder / name))
        patch.syspath_prepend(str(folder / "site"))
        yield Cell(described_cell(folder))


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> CellModel:
    return build_cell_model(plain_cell(tmp_path_factory.mktemp("plain")))


def test_the_model_is_that_of_the_plain_cell(described: Cell, plain: CellModel) -> None:
    model = build_cell_model(described.workcell)
    assert model.robots[0].joint_names == plain.robots[0].joint_names
    found, expected = (set(map(frozenset, m.geometry.pair_names)) for m in (model, plain))
    assert found == expected
    assert not any("left/grip" in name for pair in model.geometry.pair_names for name in pair)
    shifts = np.random.default_rng(1).uniform(-0.06, 0.06, (2, len(described.initial)))
    near = np.clip(described.initial + shifts, described.lower, described.upper)
    for x in (described.initial, *near):
        values = (candidate_function(m)(ca.DM(x)) for m in (model, plain))
        for value, other in zip(*values, strict=True):
            np.testing.assert_allclose(np.array(value), np.array(other), atol=1e-9)


@pytest.mark.slow
def test_an_inspection_tells_of_it(described: Cell, tmp_path: Path) -> None:
    view = tmp_path / "view.html"
    parts = list(inspected(described.workcell, 40, 1, view=view, pairs=True))
    text = "\n".join(line for part in parts for line in part.lines)
    assert re.search("left/link_1 – left/link_4: .*gofa.srdf: Never", text)
    why = {
        frozenset(pair[:2]): pair[2]
        for part in parts
        for pair in part.values.get("excluded_pairs", ())
    }
    pair = frozenset(("right/grip_finger", "middle board"))
    assert why[pair].endswith(": for the test")
    assert "left/grip_finger" not in text
    assert (tmp_path / "view.html").exists()
