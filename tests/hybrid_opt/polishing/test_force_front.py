"""The polish of fronts of the rack: better, never worse, believed only after re-evaluation."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.evaluate.objectives import front_of, non_dominated
from hybrid_opt.indicators import metrics
from hybrid_opt.polishing import force_front
from hybrid_opt.polishing.force import ForceSolver, Scalarisation, SolveMode, pascoletti_serafini
from hybrid_opt.polishing.force_attempts import (
    FAR_GAP,
    Chord,
    Edge,
    best_on_chord,
    chord_across,
    gap_attempt,
    gaps,
    made_little_progress,
    widest_untried_gap,
)
from hybrid_opt.polishing.front import (
    IMPROVEMENT_TOLERANCE,
    OPTIMAL_STATIONARITY,
    ParetoArchive,
    PolishedFront,
    Polisher,
    Solution,
)
from hybrid_opt.polishing.polisher import make_polisher
from hybrid_opt.polishing.settings import FillSettings, PolishSettings, ProbeSettings
from studies.research.best_front import read_reference_front
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.read.cell import load
from symbolic.records.task import initial_decision
from tests.hybrid_opt.cells import shipped
from tests.hybrid_opt.polishing.cells import require_progress, smooth_cell
from tests.refusals import refused
from tests.symbolic.read.samples import RACK

SETTINGS = PolishSettings(
    attempts=4, probe=ProbeSettings(4, 4), fill=FillSettings(solved=12, members=24, attempts=1)
)
PATIENT = PolishSettings(rounds=25, max_iterations=80)

SPAN = np.full(2, 0.05)
"""What the objectives of a point are scaled by."""


@cache
def evaluator() -> CandidateEvaluator:
    return CandidateEvaluator(load(RACK))


@cache
def start_front() -> Array:
    """Non-dominated random candidates."""
    rng = np.random.default_rng(5)
    x = rng.uniform(evaluator().lower, evaluator().upper, (600, evaluator().n_var))
    found = evaluator().certified(evaluator().evaluate(x))
    return np.asarray(x[non_dominated(found.objectives, found.feasible)])


@cache
def polisher() -> Polisher:
    return make_polisher(evaluator(), SETTINGS)


TOLD: list[tuple[int, int]] = []
"""Attempts done and in all, as `polished` told them."""


@cache
def polished() -> PolishedFront:
    return polisher().polish(
        start_front(),
        np.random.default_rng(0),
        on_progress=lambda done, total: TOLD.append((done, total)),
    )


def test_attempts_never_exceed_those_that_are_expected() -> None:
    require_progress(TOLD, len(polished().outcomes))


def objectives_of(x: Array) -> Array:
    return evaluator().evaluate(x).objectives


def test_the_front_gets_better_and_no_point_is_lost() -> None:
    before, after = objectives_of(start_front()), polished().objectives
    assert metrics.hypervolume(after) > metrics.hypervolume(before)
    for point in before:
        assert np.any(np.all(after <= point, axis=1))
    assert non_dominated(after).all()


def test_what_probes_reach_is_given_up_only_where_the_front_is_nearly_as_good() -> None:
    probes = [o for o in polished().outcomes if o.aim == "probe"]
    assert len(probes) > 4
    accepted = [o for o in probes if o.status == "accepted"]
    assert accepted
    front = polished().objectives
    nearly = FAR_GAP * np.ptp(front, axis=0)
    for outcome in accepted:
        assert (outcome.start - outcome.objectives).max() > 0.0
        assert np.any(np.all(front <= outcome.objectives + nearly, axis=1))


def test_points_of_the_front_never_get_worse() -> None:
    own = [o for o in polished().outcomes if o.aim == "point"]
    assert own
    for outcome in own:
        assert np.all(outcome.objectives <= outcome.start + IMPROVEMENT_TOLERANCE)
    assert sum(o.status in ("accepted", "optimal") for o in own) >= 0.9 * len(own)
    assert polished().effort.success_share == pytest.approx(
        np.mean([o.status in ("accepted", "optimal") for o in own])
    )


def test_every_point_is_feasible_for_the_full_evaluator_and_certified() -> None:
    found = evaluator().certified(evaluator().evaluate(polished().x))
    assert found.feasible.all()
    np.testing.assert_array_equal(found.objectives, polished().objectives)


def test_residuals_of_accepted_points_are_told() -> None:
    accepted = [o for o in polished().outcomes if o.status == "accepted"]
    # Whatever a program asked for beyond that, what is accepted holds.
    found = evaluator().evaluate(np.array([outcome.x for outcome in accepted]))
    assert found.feasible.all()
    np.testing.assert_array_equal(found.objectives, [o.objectives for o in accepted])
    for outcome in accepted:
        residuals = outcome.residuals
        # Feasibility may be large where the last step was a part of a refused one.
        assert np.isfinite([residuals.stationarity, residuals.feasibility]).all()
        assert outcome.iterations > 0


def test_with_time_points_become_stationary() -> None:
    """Two of five at least: the rows of a last step that was refused ask for more than the answer
    keeps, which is no optimum of that program then. Which points that befalls depends on the
    machine's arithmetic.
    """
    solver = ForceSolver(smooth_cell(evaluator()), PATIENT)
    limits, stationary = [1e-4, 1e-6, OPTIMAL_STATIONARITY], 0
    for x in [initial_decision(evaluator().workcell.task), *start_front()]:
        target = pascoletti_serafini(objectives_of(x[None])[0], SPAN)
        residuals = solver.solve(x, target, radius=1.0).residuals
        found = [residuals.stationarity, residuals.feasibility, residuals.complementarity]
        stationary += bool(np.all(np.array(found) < limits))
        if stationary == 2:
            return
    pytest.fail(f"{stationary} of {1 + len(start_front())} are stationary")


def test_what_it_cost_is_told_in_evaluations() -> None:
    result = polished()
    assert result.seconds > 0.0
    assert result.effort.equivalent_evaluations == pytest.approx(
        result.seconds / result.evaluation_seconds, abs=1.0
    )
    ends_and_middle = 3
    most = SETTINGS.attempts * (1 + 2 * SETTINGS.fill.attempts) + ends_and_middle
    beside_probes = sum(o.aim != "probe" for o in result.outcomes)
    assert SETTINGS.attempts < beside_probes <= most
    assert sum(o.status == "accepted" for o in result.outcomes) == result.counts["accepted"]


def test_a_front_of_one_point() -> None:
    one = evaluator().workcell.task.initial.reshape(1, -1)
    result = make_polisher(evaluator(), replace(SETTINGS, attempts=1)).polish(
        one, np.random.default_rng(0)
    )
    assert np.any(np.all(result.objectives <= objectives_of(one)[0], axis=1))
    assert result.outcomes[0].parent == 0


def test_an_empty_front() -> None:
    result = polisher().polish(np.empty((0, evaluator().n_var)), np.random.default_rng(0))
    assert result.x.shape == (0, evaluator().n_var)
    assert result.objectives.shape == (0, 2)
    assert result.outcomes == ()
    assert result.counts == {}
    assert np.isnan(result.effort.success_share)


def test_infeasible_points_are_no_front() -> None:
    x = np.vstack([evaluator().lower, evaluator().upper])
    assert not evaluator().evaluate(x).feasible.any()
    assert len(polisher().polish(x, np.random.default_rng(0)).x) == 0


def test_no_points_means_no_polish() -> None:
    result = make_polisher(evaluator(), PolishSettings(attempts=0)).polish(
        start_front(), np.random.default_rng(0)
    )
    assert result.outcomes == ()
    assert not result.polished.any()


@pytest.mark.slow
def test_ipopt_finds_as_good_a_front() -> None:
    result = make_polisher(evaluator(), replace(SETTINGS, solver="ipopt")).polish(
        start_front(), np.random.default_rng(0)
    )
    assert (polished().solver, result.solver) == ("dense", "ipopt")
    found, usual = (metrics.hypervolume(one.objectives) for one in (result, polished()))
    assert found == pytest.approx(usual, abs=1e-3)
    assert not np.array_equal(result.x, polished().x)


def test_other_objectives_are_refused() -> None:
    other = CandidateEvaluator(load(RACK), ("duration", "mean_force"))
    with refused(SettingsError, "objectives"):
        make_polisher(other, SETTINGS)


class Broken(ForceSolver):
    """A solver whose attempts end in every bad way in turn."""

    def solve(
        self, x: Array, target: Scalarisation, radius: float, mode: SolveMode = "usual"
    ) -> Solution:
        found = super().solve(x, target, radius, mode)
        mood = int(1e6 * x[0]) % 3
        if mood == 0:
            raise FloatingPointError("broken\nall over")
        if mood == 1:
            return replace(found, x=evaluator().lower)  # claims success, far outside
        return replace(found, usable=False, message="Invalid_Number_Detected")


def test_a_broken_solver_loses_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(force_front, "ForceSolver", Broken)
    polisher = make_polisher(evaluator(), PolishSettings(attempts=9, rounds=1))
    result = polisher.polish(start_front(), np.random.default_rng(0))
    before = objectives_of(start_front())
    order = np.lexsort(before.T[::-1])
    np.testing.assert_array_equal(result.objectives, before[order])
    assert {outcome.status for outcome in result.outcomes} <= {"failed", "rejected"}
    assert all(outcome.reason for outcome in result.outcomes)
    assert "FloatingPointError: broken" in {outcome.reason for outcome in result.outcomes}
    for outcome in result.outcomes:
        np.testing.assert_array_equal(outcome.objectives, outcome.start)


def front(*objectives: tuple[float, float]) -> ParetoArchive:
    """All polished; each decision vector is its index."""
    x = np.arange(float(len(objectives)))[:, None]
    archive = ParetoArchive(x, np.array(objectives), list(range(len(objectives))))
    archive.polished = [True] * len(objectives)
    return archive


def test_gaps_are_measured_in_units_of_the_front() -> None:
    found = gaps(front((0.0, 10.0), (1.0, 2.5), (4.0, 0.0)))
    assert [(gap.first, gap.second) for gap in found] == [(0, 1), (1, 2)]
    assert [gap.length for gap in found] == pytest.approx([0.25 + 0.75, 0.75 + 0.25])
    assert [gap.width for gap in found] == pytest.approx([(0.25 * 0.75) ** 0.5] * 2)


def test_the_widest_gap_is_next_half_way_along_it() -> None:
    archive = front((0.0, 1.0), (0.1, 0.8), (1.0, 0.0))
    found = gap_attempt(archive, set(), 10, stride=10.0, far=0.4)
    assert found is not None
    attempt = found.attempt
    assert attempt.mode == "near"
    assert found.edge == _edge(archive, 1, 2)
    np.testing.assert_array_equal(attempt.start, [0.1, 0.8])
    # The target's diagonal meets the chord half way: its difference of objectives is the mean.
    anchor = attempt.target.anchor
    assert anchor[0] - anchor[1] == pytest.approx((0.1 - 0.8 + 1.0 - 0.0) / 2.0)


def test_a_stride_is_never_longer_than_asked() -> None:
    archive = front((0.0, 1.0), (1.0, 0.0))
    found = gap_attempt(archive, set(), 32, stride=0.3)
    assert found is not None
    anchor = found.attempt.target.anchor
    assert (anchor[0] - anchor[1]) - (0.0 - 1.0) == pytest.approx(0.3)


def test_sides_are_tried_once_each_and_gaps_left_then() -> None:
    archive, tried = front((0.0, 1.0), (0.2, 0.3), (1.0, 0.0)), set[Edge]()
    order = []
    while (found := gap_attempt(archive, tried, 10, stride=10.0, far=0.4)) is not None:
        tried.add(found.edge)
        order.append(found.edge)
    near = [_edge(archive, 1, 2), _edge(archive, 2, 1)]
    far = [(first, second, False) for first, second, _ in near]
    narrow = [_edge(archive, 0, 1), _edge(archive, 1, 0)]
    assert order == near + far + narrow


def test_a_point_beside_the_start_has_crept() -> None:
    archive = front((0.0, 1.0), (1.0, 0.0))
    found = gap_attempt(archive, set(), 32, stride=0.4)
    assert found is not None
    assert made_little_progress(archive, found, np.array([0.05, 0.95]))
    assert not made_little_progress(archive, found, np.array([0.1, 0.8]))


def test_enough_points_are_enough() -> None:
    assert gap_attempt(front((0.0, 1.0), (1.0, 0.0)), set(), 2) is None
    assert gap_attempt(front((0.0, 1.0)), set(), 10) is None


def _edge(archive: ParetoArchive, start: int, across: int) -> Edge:
    vectors: list[Array] = archive.x
    return vectors[start].tobytes(), vectors[across].tobytes(), True


def archive_of_polished() -> ParetoArchive:
    """Every fourth member of a polished front."""
    x, objectives = polished().x[::4], polished().objectives[::4]
    archive = ParetoArchive(x, objectives, list(range(len(x))))
    archive.polished = [True] * len(x)
    return archive


def test_the_widest_chords_come_first_and_each_once() -> None:
    archive, tried, widths = front((0.0, 9.0), (1.0, 4.0), (2.0, 3.0), (9.0, 0.0)), set[Chord](), []
    while (gap := widest_untried_gap(archive, tried)) is not None:
        tried.add(chord_across(archive, gap))
        widths.append(gap.width)
    assert len(widths) == 3
    assert widths == sorted(widths, reverse=True)


def test_a_point_on_a_chord_is_feasible_and_wins_area() -> None:
    archive, found = archive_of_polished(), 0
    before = metrics.hypervolume(np.array(archive.objectives))
    for gap in gaps(archive):
        point = best_on_chord(evaluator(), archive, gap)
        if point is None:
            continue
        x, objectives = point
        judged = evaluator().evaluate(x)
        assert judged.feasible[0]
        np.testing.assert_array_equal(judged.objectives[0], objectives)
        assert metrics.hypervolume(np.array([*archive.objectives, objectives])) > before
        drive_method = archive.x[gap.second] - archive.x[gap.first]
        share = (x - archive.x[gap.first]) @ drive_method / (drive_method @ drive_method)
        assert 0.0 < share < 1.0
        np.testing.assert_allclose(x, archive.x[gap.first] + share * drive_method, atol=1e-12)
        found += 1
    assert found > 0


def test_a_chord_through_what_is_infeasible_leads_nowhere() -> None:
    archive = archive_of_polished()
    archive.x[0], archive.x[1] = evaluator().lower, evaluator().upper
    gap = next(gap for gap in gaps(archive) if {gap.first, gap.second} == {0, 1})
    assert best_on_chord(evaluator(), archive, gap) is None


FRONT = Path(__file__).with_name("rack_reference_front.csv")


def test_every_point_is_feasible_certified_and_of_the_stored_value() -> None:
    front = read_reference_front(FRONT)
    evaluator = shipped("rack").evaluator
    assert front.digest == evaluator.workcell.digest
    found = evaluator.certified(evaluator.evaluate(front.x))
    assert found.feasible.all()
    np.testing.assert_allclose(found.objectives, front.objectives, rtol=1e-9)
    assert len(front_of(front.objectives)) == len(front.objectives)
