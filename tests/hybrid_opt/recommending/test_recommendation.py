"""The recommended carry against timings found by other means, and what its words rest on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import hybrid_opt as ho
from hybrid_opt.evaluate.objectives import ROBUST_OBJECTIVES
from hybrid_opt.indicators.selection import knee
from hybrid_opt.recommending.choice import DrivenPaths, force_for_payload
from hybrid_opt.recommending.comparison import Rival, front_durations, spread_members, table_forces
from hybrid_opt.recommending.recommendation import HAND_MADE, usual_doubts
from hybrid_opt.robust.squeeze import commanded_forces
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.records import Uncertainty
from tests.symbolic.read.samples import RACK


def timed(cell: ho.Cell, path: Array, force: float) -> ho.Timing:
    """By the linear programs of `time_path`, which share nothing with the compiled timing."""
    return ho.time_path(cell, np.append(path, force), ho.TimingLimits(force=force))


def test_without_a_wish_it_is_the_knee(drivable: ho.Cell, front: ho.Front) -> None:
    found = ho.recommend(drivable, front.x)
    timings = [timed(drivable, x[:-1], x[-1]) for x in front.x]
    points = [(t.duration, t.carry.peak_normal_force.max()) for t in timings if t.carry is not None]
    duration, force = points[knee(np.array(points))]
    # The two timings agree to a percent of the force beyond that of holding still.
    assert found.force == pytest.approx(force, rel=5e-3)
    assert found.timing.ok
    assert found.timing.duration <= duration * 1.01
    assert found.carry.peak_normal_force.max() <= found.force * 1.005
    np.testing.assert_array_equal(found.x[:-1], front.x[found.member, :-1])
    assert found.x[-1] == found.force
    assert "knee" in repr(found)


def test_with_a_force_it_is_the_fastest_path_at_that_force(
    drivable: ho.Cell, front: ho.Front
) -> None:
    found = ho.recommend(drivable, front.x, ho.Wish(force=52.0))
    best = min(timed(drivable, x[:-1], 52.0).duration for x in front.x)
    assert found.force == 52.0
    assert found.timing.duration == pytest.approx(best, rel=2e-3)


def test_with_a_duration_no_path_does_it_with_less_force(
    drivable: ho.Cell, front: ho.Front
) -> None:
    found = ho.recommend(drivable, front.x, ho.Wish(duration=3.2))
    assert found.jerk is not None
    driven, unlimited = found.jerk.timing.duration, found.timing.duration
    # The compiled timing, which finds the force, is up to some percent slower than the judge.
    assert 0.97 * 3.2 < driven < 3.2 * (1.0 + 2e-3)
    less = found.force - 0.5
    assert min(timed(drivable, x[:-1], less).duration for x in front.x) > unlimited * (1.0 - 1e-3)


def test_with_a_payload_the_same_motion_bears_it(drivable: ho.Cell, front: ho.Front) -> None:
    found = ho.recommend(drivable, front.x, ho.Wish(payload=16.0))
    assert found.carry.payload_limit >= 16.0 * (1.0 - 1e-3)
    # Torsion leaves a part of the cones unused where the box is tilted; no more is given away.
    assert found.carry.payload_limit < 17.0
    assert found.carry.peak_normal_force.max() == pytest.approx(found.force, rel=2e-3)
    assert force_for_payload(drivable.workcell, 16.0) == found.force


def test_limits_on_jerk_are_kept_and_what_they_cost_is_told(
    drivable: ho.Cell, front: ho.Front
) -> None:
    found = ho.recommend(drivable, front.x, ho.Wish(duration=3.2))
    assert found.jerk is not None
    carry = found.jerk.timing.carry
    assert carry is not None
    assert found.jerk.without == found.timing.duration
    assert 0.0 < found.jerk.cost < 0.2
    jerk = np.diff(carry.side_by_side("q_second"), axis=0) / np.diff(carry.time)[:, None]
    stated = [robot.jerk_max for robot in drivable.workcell.robots]
    assert stated[0] is not None
    assert np.abs(jerk).max() <= stated[0].min() * 1.01
    assert carry.normal_force.max() <= found.force * 1.005
    assert found.jerk.timing.ok
    assert carry.duration <= 3.2 * 1.001
    assert f"{found.jerk.timing.duration:.3f} s" in repr(found)


def test_the_hand_made_carry_stands_beside_it(drivable: ho.Cell, front: ho.Front) -> None:
    found = ho.recommend(drivable, front.x, ho.Wish(force=52.0))
    (rival,) = found.rivals
    assert rival.label == HAND_MADE
    own = timed(drivable, drivable.initial[:-1], 52.0).duration
    assert rival.duration_at_force == own
    again = timed(drivable, drivable.initial[:-1], rival.force_at_duration).duration
    assert again == pytest.approx(found.timing.duration, rel=2e-2)


def test_a_better_path_is_warned_of(drivable: ho.Cell, front: ho.Front) -> None:
    force = 70.0
    durations = [timed(drivable, x[:-1], force).duration for x in front.x]
    quick, slow = front.x[int(np.argmin(durations))], front.x[int(np.argmax(durations))]
    assert min(durations) < 0.98 * max(durations)
    both = np.array([np.append(slow[:-1], force) for force in (68.0, 72.0)])
    found = ho.recommend(drivable, both, ho.Wish(force=force), {"other": quick[:-1]})
    assert any("other trajectory is better" in text for text in found.warnings)
    other = found.rivals[1]
    assert other.duration_at_force < found.timing.duration
    assert other.force_at_duration < found.force
    assert other.faster_between is not None
    alone = ho.recommend(drivable, quick[None], ho.Wish(force=force), {"other": slow[:-1]})
    assert not any("other" in text for text in alone.warnings)


def test_doubts_cost_force_in_proportion(drivable: ho.Cell, front: ho.Front) -> None:
    found = ho.recommend(drivable, front.x)
    doubts = {doubt.doubt: doubt for doubt in found.unsure}
    assert list(doubts) == list(usual_doubts(drivable.workcell))
    peak = found.carry.peak_normal_force.max()
    # At rest and level the force is m g / (2 mu); moving, the same factors hold nearly.
    assert doubts["friction 10 % off"].peak_force.max() == pytest.approx(peak / 0.9, rel=5e-3)
    assert doubts["mass 5 % off"].peak_force.max() == pytest.approx(peak * 1.05, rel=5e-3)
    assert all(doubt.within_reference for doubt in found.unsure)


def test_a_carry_without_room_for_errors_is_warned_of(drivable: ho.Cell, front: ho.Front) -> None:
    """The fastest timing of a path uses the contact patches up to their rims."""
    fastest = ho.recommend(drivable, front.x, ho.Wish(force=110.0))
    shift = fastest.carry.peak_pressure_shift.max()
    room = drivable.workcell.contacts[0].patch_radius - shift
    warned = [text for text in fastest.warnings if "no room" in text]
    assert bool(warned) == (room < 1e-3)
    gentle = ho.recommend(drivable, front.x, ho.Wish(force=50.5))
    assert not any("no room" in text for text in gentle.warnings)


def test_a_wish_for_a_duration_is_kept_within_limits_on_jerk(
    drivable: ho.Cell, front: ho.Front
) -> None:
    """The rack limits jerk, and its carries are driven within these limits."""
    unlimited = ho.recommend(drivable, front.x, ho.Wish(force=60.0))
    asked = 1.1 * unlimited.timing.duration
    found = ho.recommend(drivable, front.x, ho.Wish(duration=asked))
    assert found.wish.duration == asked
    assert found.jerk is not None
    assert found.jerk.timing.duration <= asked * 1.001
    assert found.jerk.timing.duration > 0.97 * asked  # nothing is given away
    assert not any("limits on jerk" in text for text in found.warnings)
    shortest = ho.recommend(drivable, front.x, ho.Wish(force=drivable.workcell.task.force_limit[1]))
    hardly = ho.recommend(drivable, front.x, ho.Wish(duration=1.025 * shortest.timing.duration))
    assert any("no other carry of the front" in text for text in hardly.warnings)


def test_what_a_rival_cannot_is_told_in_words() -> None:
    inf = float("inf")
    assert str(Rival("hand-made", inf, inf)) == (
        "hand-made: cannot move with so little force, is never so fast"
    )
    assert str(Rival("hand-made", 2.0, 55.0)) == (
        "hand-made: 2.000 s at the same force, 55.00 N in the same time"
    )


def test_wishes_that_nothing_answers_say_what_is_possible(
    drivable: ho.Cell, front: ho.Front
) -> None:
    with pytest.raises(SettingsError, match="the shortest takes"):
        ho.recommend(drivable, front.x, ho.Wish(duration=0.5))
    with pytest.raises(SettingsError, match=r"holding still takes 49\.\d\d N"):
        ho.recommend(drivable, front.x, ho.Wish(force=40.0))
    with pytest.raises(SettingsError, match="payload 30 kg"):
        ho.recommend(drivable, front.x, ho.Wish(payload=30.0))
    with pytest.raises(SettingsError, match="empty"):
        ho.recommend(drivable, np.zeros((0, 19)))
    with pytest.raises(SettingsError, match="drivable"):
        ho.recommend(ho.Cell.load(RACK), front.x)


@pytest.mark.parametrize(
    "values", [{"duration": 2.0, "force": 52.0}, {"duration": 0.0}, {"payload": float("nan")}]
)
def test_odd_wishes_are_refused(values: dict[str, float]) -> None:
    with pytest.raises(SettingsError):
        ho.Wish(**values)


def test_a_front_is_as_fast_as_its_fastest_member(drivable: ho.Cell, front: ho.Front) -> None:
    forces = table_forces(drivable.workcell)
    assert forces == pytest.approx(np.array([1.02, 1.04, 1.06, 1.08, 1.12, 1.2]) * 49.05)
    members = spread_members(front.x)
    paths = DrivenPaths(drivable.path_timer, members[:, :-1], 117.0)
    every = np.array([paths.durations(force) for force in forces])
    np.testing.assert_array_equal(front_durations(paths, forces), every.min(axis=1))
    np.testing.assert_array_equal(members[[0, -1]], front.x[[0, -1]])


def test_a_drivable_cell_is_the_same_cell(drivable: ho.Cell) -> None:
    cell = ho.Cell.load(RACK)
    assert drivable.objective_names == ("duration", "peak_force")
    np.testing.assert_array_equal(drivable.initial[:-1], cell.initial)
    assert drivable.workcell.source.is_file()
    assert not drivable.force_kind.robust
    assert ho.Cell.load(RACK, ROBUST_OBJECTIVES).drivable().force_kind.robust


@pytest.mark.parametrize("uncertainty", [Uncertainty(), Uncertainty(friction=0.1, mass=0.03)])
def test_the_job_presses_as_hard_as_recommended(
    drivable: ho.Cell, uncertainty: Uncertainty
) -> None:
    cell = ho.Cell(replace(drivable.workcell, uncertainty=uncertainty))
    timing = ho.time_path(cell, cell.initial)
    assert timing.carry is not None
    forces, squeeze = commanded_forces(cell.workcell, timing.carry, ho.SqueezeSettings())
    assert (squeeze.uncertainty is None) == uncertainty.is_empty
    (carry,) = (phase for phase in ho.plan_job(timing).phases if phase.name == "carry")
    # The job's window of smoothing reaches into what it does before and after.
    np.testing.assert_allclose(carry.force.normal.max(axis=0), forces.max(axis=0), rtol=0.02)
