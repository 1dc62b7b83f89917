"""The recommended carry against timings and forces found by other means."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq

import hybrid_opt as ho
from hybrid_opt.carry import BoxMotion
from hybrid_opt.errors import JobError
from hybrid_opt.evaluate.objectives import ROBUST_OBJECTIVES
from hybrid_opt.job.plan import JobModel
from hybrid_opt.recommending.advice import changes_of_cell
from hybrid_opt.recommending.choice import DrivenPaths
from hybrid_opt.recommending.recommendation import (
    HAND_MADE,
    STEPS,
    Recommendation,
    commanded_durations,
    spread_rows,
    table_forces,
)
from hybrid_opt.robust.cases import random_cases
from hybrid_opt.robust.force import RobustModel, robust_model, subsample
from hybrid_opt.robust.squeeze import commanded_forces
from hybrid_opt.timing.jerk import driven_timing
from hybrid_opt.timing.solve import time_path
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.path.spline import resample_decisions
from symbolic.read.cell import changed
from symbolic.records import USUAL_UNCERTAINTY, Contact, Task
from symbolic.records.cell import RANGES
from symbolic.records.poses import box_rotation
from tests.hybrid_opt import cells
from tests.hybrid_opt.robust.test_force import SMALL as SET
from tests.hybrid_opt.robust.test_force import model, motion
from tests.refusals import refused
from tests.symbolic.read.samples import RACK


@pytest.fixture(scope="module")
def drivable() -> ho.Cell:
    """The rack under the time law 'optimal'."""
    return cells.drivable("rack")


@pytest.fixture(scope="module")
def front(drivable: ho.Cell) -> ho.Front:
    """What a short search finds there."""
    return ho.search(drivable, "nsga2", evaluations=160, rng=np.random.default_rng(3))


def timed(cell: ho.Cell, path: Array, force: float) -> ho.Timing:
    """By the linear programs of `time_path`, which share nothing with the compiled timing."""
    return ho.time_path(cell, np.append(path, force), ho.TimingLimits(force=force))


def held(cell: ho.Cell, carry: ho.Carry | None) -> Array:
    """(n,) what is to be commanded of arm 2 along a carry [N]."""
    assert carry is not None
    return robust_model(cell.workcell).hold(carry, cell.workcell.uncertainty)[0]


@pytest.fixture(scope="module")
def found(drivable: ho.Cell, front: ho.Front) -> Recommendation:
    """Without a wish."""
    steps: list[tuple[int, int]] = []
    answer = ho.recommend(front, progress=lambda done, total: steps.append((done, total)))
    assert steps == [(k + 1, STEPS + 1) for k in range(STEPS + 1)]
    return answer


def test_no_path_has_a_smaller_product(
    drivable: ho.Cell, front: ho.Front, found: Recommendation
) -> None:
    longer = found.duration / timed(drivable, found.x[:-1], found.limit).duration
    assert 1.0 < longer < 1.1
    for x in front.x:
        for limit in (found.limit, 1.02 * found.limit):
            timing = timed(drivable, x[:-1], limit)
            if timing.ok:
                force = held(drivable, timing.carry).max()
                # Two timings, and limits on jerk that cost one path more than another.
                assert found.duration * found.force < 1.03 * timing.duration * longer * force
    np.testing.assert_array_equal(found.x[:-1], front.x[found.member, :-1])


def test_it_holds_in_random_cases_with_what_is_commanded(
    drivable: ho.Cell, found: Recommendation
) -> None:
    assert not [text for text in found.warnings if "better" not in text]
    assert (found.commanded <= drivable.workcell.task.reference_force).all()
    assert found.job is not None
    phase, doubt = found.job.phase("carry"), drivable.workcell.uncertainty
    assert doubt.stated
    rows = np.linspace(0, len(phase.motion.time) - 1, 60).astype(int)
    cases = random_cases(drivable.workcell, doubt, 400, np.random.default_rng(1))
    parts = (phase.motion.pose, phase.motion.rate, phase.motion.second_rate)
    at = BoxMotion(*[np.ascontiguousarray(part[rows]) for part in parts])
    needed = robust_model(drivable.workcell).least_squeeze(at, cases)[:, :, 1]
    assert (needed <= phase.force.normal[rows, 1] * (1.0 + 1e-9)).all()


@pytest.mark.parametrize("allowed", [98.5, 109.0, 112.5])
def test_no_arm_feels_more_than_its_reference_force(
    drivable: ho.Cell, front: ho.Front, allowed: float
) -> None:
    """Nor the leading one, which feels disturbances beside what is commanded."""
    task = replace(drivable.workcell.task, reference_force=np.full(2, allowed))
    cell = ho.Cell(replace(drivable.workcell, task=task), drivable.objective_names)
    answer = ho.recommend(ho.Front.of(cell, front.x), alone=True)
    assert not answer.warnings
    held = robust_model(drivable.workcell).hold(answer.carry, drivable.workcell.uncertainty)
    assert max(each.max() for each in held) <= allowed * 1.003


def test_one_duration_and_one_force(drivable: ho.Cell, found: Recommendation) -> None:
    """Those of its job, of one that is planned anew, and of what an export plans from its file."""
    assert found.job is not None
    model = drivable.timing_model
    exported = time_path(model, found.x, model.drive_limits(found.limit))
    jobs = JobModel(drivable.compiled, drivable.timing_model)
    for job in (found.job, ho.plan_job(found), jobs.plan(exported)):
        assert job.phase("carry").duration == pytest.approx(found.duration, abs=1e-9)
        assert job.squeeze.force == pytest.approx(found.force, rel=1e-9)
        assert job.peak_normal_force[1] == pytest.approx(found.force, rel=1e-9)
        assert job.duration == pytest.approx(found.job.duration, abs=1e-9)
    assert f"{found.duration:.3f} s" in repr(found)
    assert f"{found.force:.1f} N" in repr(found)
    assert sum(part.force for part in found.squeeze.parts) == pytest.approx(found.force)


def test_a_job_beyond_a_limit_gives_way_to_a_gentler_carry(
    drivable: ho.Cell, front: ho.Front, found: Recommendation
) -> None:
    """Where arms are so weak that they may not press as hard as in the best carry's job."""
    assert found.job is not None
    share = 0.95 * found.job.phase("carry").use["joint torque"]
    robots = enumerate(drivable.workcell.robots)
    weak = drivable.changed(
        {f"robots[{k}].torque_max": share * robot.torque_max for k, robot in robots}
    )
    with refused(JobError, "beyond-a-limit", "joint torque"):
        ho.plan_job(driven_timing(weak.timing_model, found.x))
    answer = ho.recommend(ho.Front.of(weak, front.x), alone=True)
    assert answer.job is not None
    assert not answer.warnings
    assert answer.force < found.force
    assert answer.duration > found.duration


def test_limits_on_jerk_are_kept(drivable: ho.Cell, found: Recommendation) -> None:
    carry = found.carry
    jerk = np.diff(carry.stack_arms("q_second"), axis=0) / np.diff(carry.time)[:, None]
    stated = [robot.jerk_max for robot in drivable.workcell.robots]
    assert stated[0] is not None
    assert np.abs(jerk).max() <= stated[0].min() * 1.01
    assert found.limited_force.max() <= found.limit * 1.005


def test_wishes_are_kept_and_little_is_given_away(
    drivable: ho.Cell, front: ho.Front, found: Recommendation
) -> None:
    force = 0.95 * found.force
    gentle = ho.recommend(front, ho.Wish(force=force), alone=True)
    assert 0.97 * force < gentle.force <= force * 1.002
    assert gentle.duration > found.duration
    asked = 1.2 * found.duration
    slow = ho.recommend(front, ho.Wish(duration=asked), alone=True)
    assert slow.wish.duration == asked
    assert 0.97 * asked < slow.duration <= asked * 1.002
    assert slow.force < found.force


def test_the_cost_of_a_partners_stop_is_told(
    drivable: ho.Cell, front: ho.Front, found: Recommendation
) -> None:
    """72 mm within 0.3 s are 0.24 m/s, and the same path without that limit is faster."""
    slow = drivable.changed({"handling.partner_stop": 0.072})
    answer = ho.recommend(ho.Front.of(slow, front.x[[found.member]]))
    speed = np.linalg.norm(answer.carry.rate[:, :3], axis=1).max()
    assert speed == pytest.approx(0.24, rel=1e-3)
    other = answer.rivals[-1]
    assert "without partner_stop" in repr(answer)
    assert found.duration < other.duration_at_force < answer.duration
    # Each pad also turns with the box: what it moves in that time, by the poses alone.
    motion, cell, apart = answer.carry, slow.workcell, 0.0
    time = np.linspace(0.0, motion.time[-1], 2000)
    pose = np.column_stack([np.interp(time, motion.time, column) for column in motion.pose.T])
    turned = box_rotation(cell.task.orientation, pose)
    later = np.searchsorted(time, time + 0.3, side="right") - 1
    for contact in cell.contacts:
        pad = pose[:, :3] + turned @ contact.T_box_pad[:3, 3]
        apart = max(apart, float(np.linalg.norm(pad[later] - pad, axis=1).max()))
    told = [text for text in answer.warnings if "partner_stop" in text]
    assert bool(told) == (apart > 0.0721)
    if told:
        assert f" {1e3 * apart:.0f} mm" in told[0]
        assert " 72 mm" in told[0]


def test_more_payload_takes_more_force(drivable: ho.Cell, front: ho.Front) -> None:
    """In the command, in the job, and by a model of the heavier box that shares nothing with it."""
    box, last = drivable.workcell.payload, 0.0
    few = ho.Front.of(drivable, front.x[:3])
    for mass in (7.0, 10.0, 12.5):
        found = ho.recommend(few, ho.Wish(payload=mass), alone=True)
        heavier = replace(box, mass=mass, inertia=mass / box.mass * box.inertia)
        model = RobustModel(
            replace(drivable.workcell, payload=heavier, task=soft(drivable.workcell.task))
        )
        needed = model.hold(found.carry, drivable.workcell.uncertainty)[0].max()
        assert found.carry.workcell.payload.mass == mass
        assert found.force >= needed * (1.0 - 1e-6)
        assert found.job is not None
        assert found.job.workcell.payload.mass == mass
        assert found.job.peak_normal_force[1] == pytest.approx(found.force, rel=1e-9)
        assert found.force > last
        last = found.force
        assert found.fits == (found.required.max() <= 117.68 * 1.001)
    assert not found.fits  # 12.5 kg are too heavy


def soft(task: Task) -> Task:
    """The task with pads that press evenly."""
    return replace(task, allocation="soft-finger")


def test_a_heavier_box_takes_more_force_in_the_same_time(
    front: ho.Front, drivable: ho.Cell
) -> None:
    few = ho.Front.of(drivable, front.x[:3])
    light, heavy = (
        ho.recommend(few, ho.Wish(duration=4.0, payload=mass), alone=True) for mass in (6.0, 8.0)
    )
    assert heavy.force > 1.1 * light.force
    assert str(heavy.wish).endswith(" 8 kg")


def test_a_heavier_box_takes_longer_within_the_same_force(
    front: ho.Front, drivable: ho.Cell
) -> None:
    few = ho.Front.of(drivable, front.x[:3])
    light, heavy = (
        ho.recommend(few, ho.Wish(force=100.0, payload=mass), alone=True) for mass in (8.0, 9.5)
    )
    assert heavy.duration > light.duration
    assert max(light.force, heavy.force) <= 100.2


def test_other_numbers_of_the_cell_are_those_of_its_file(
    drivable: ho.Cell, front: ho.Front
) -> None:
    """A wish for another reference force or uncertainty is a cell whose file says so."""
    few = ho.Front.of(drivable, front.x[:3])
    doubt = drivable.workcell.uncertainty.changed(0.5).changed({"friction": 0.02})
    found = ho.recommend(few, ho.Wish(reference_force=105.0, uncertainty=doubt), alone=True)
    own = {f"uncertainty.{name}": getattr(doubt, name) for name in (*RANGES, "stiffness")}
    cell = drivable.changed({"task.reference_force": 105.0, **own})
    same = ho.recommend(ho.Front.of(cell, few.x), alone=True)
    assert (found.duration, found.force) == (same.duration, same.force)
    np.testing.assert_array_equal(found.carry.workcell.task.reference_force, [105.0, 105.0])
    assert str(found.squeeze.uncertainty) == str(doubt)
    wide = ho.recommend(few, alone=True)
    assert found.force < wide.force  # less is uncertain
    with pytest.raises(SettingsError, match="wind"):
        doubt.changed({"wind": 1.0})


def test_the_hand_made_carry_stands_beside_it(drivable: ho.Cell, found: Recommendation) -> None:
    (rival,) = found.rivals
    assert rival.label == HAND_MADE
    path = drivable.initial[:-1]
    limits = np.linspace(found.limit - 2.0, found.limit + 2.0, 9)
    timings = [timed(drivable, path, limit) for limit in limits]
    forces = [held(drivable, timing.carry).max() for timing in timings]
    durations = [timing.duration for timing in timings]
    # The same at equal force, but for its own limits on jerk.
    without = np.interp(found.force, forces, durations)
    assert without < rival.duration_at_force < 1.1 * without
    assert found.duration < rival.duration_at_force * 1.01 or found.warnings


def test_a_better_path_is_warned_of(drivable: ho.Cell, front: ho.Front) -> None:
    durations = DrivenPaths(drivable, front.x[:, :-1]).durations(57.0)
    quick, slow = front.x[int(np.argmin(durations))], front.x[int(np.argmax(durations))]
    assert min(durations) < 0.98 * max(durations)
    alone = ho.recommend(ho.Front.of(drivable, slow[None]), None, {"sketch": quick[:-1]})
    assert any("sketch" in text for text in alone.warnings)
    assert alone.rivals[1].duration_at_force < alone.duration
    assert alone.rivals[1].force_at_duration < alone.force


def test_advice_is_what_changes_of_the_cell_change(
    drivable: ho.Cell, found: Recommendation
) -> None:
    told = {each.change: each for each in found.advice}
    cell = drivable.workcell
    contacts = [replace(contact, friction=contact.friction + 0.05) for contact in cell.contacts]

    def force(contacts: list[Contact]) -> float:
        changed = replace(cell, contacts=(contacts[0], contacts[1]))
        return float(RobustModel(changed).hold(found.carry, cell.uncertainty)[0].max())

    now = force(list(cell.contacts))
    rubs = told["friction 0.05 higher"]
    assert rubs.force == pytest.approx(force(contacts) - now, rel=0.02)
    assert rubs.duration < 0.0
    wider = [replace(contact, patch_radius=0.0325) for contact in cell.contacts]
    wide = told["patches 1 mm wider to each side"]
    assert wide.force == pytest.approx(force(wider) - now, rel=0.1)
    (level,) = (each for name, each in told.items() if "now 55 mm above" in name)
    lowered = []
    for contact in cell.contacts:
        pad = contact.T_box_pad.copy()
        pad[2, 3] = 0.0
        lowered.append(replace(contact, T_box_pad=pad))
    assert level.force == pytest.approx(force(lowered) - now, rel=0.05)
    assert level is found.advice[0]  # it costs most
    # No carry takes less than no time, however much force a change saves.
    assert all(each.duration > -found.timing.duration for each in found.advice)
    paths = DrivenPaths(drivable, found.x[:-1])
    (own,) = paths.options(found.limit)

    def beyond(limit: float) -> float:
        return paths.options(limit)[0].commanded - (own.commanded - rubs.force)

    (faster,) = paths.options(brentq(beyond, found.limit, 2.0 * found.limit, xtol=1e-3))
    assert rubs.duration == pytest.approx(faster.duration - own.duration, rel=0.1)


def test_margins_are_those_at_the_commanded_force(found: Recommendation) -> None:
    margins = {margin.quantity: margin for margin in found.margins}
    doubt = found.carry.workcell.uncertainty
    assert margins["friction of both contacts"].limit < 1.0 - doubt.friction
    assert margins["mass"].limit > 10.0 * (1.0 + doubt.mass)
    assert margins["share of the force that is missing"].limit > doubt.tracking
    for axis in "xyz":
        assert margins[f"centre of mass towards +{axis}"].limit > doubt.centre_of_mass[0]
    friction = margins["friction of both contacts"]
    contacts = [replace(c, friction=friction.limit) for c in found.carry.workcell.contacts]
    slips = replace(found.carry.workcell, contacts=(contacts[0], contacts[1]))
    needed = RobustModel(slips).nominal(found.carry)[:, 1]
    forces, _ = commanded_forces(found.carry.workcell, found.carry, ho.SqueezeSettings())
    assert (needed / forces[:, 1]).max() == pytest.approx(1.0, abs=5e-3)


def test_where_nothing_fits_it_says_what_would_do(drivable: ho.Cell, front: ho.Front) -> None:
    """The rack's robots are too weak for the usual set."""
    unsure = ho.Cell(
        replace(drivable.workcell, uncertainty=USUAL_UNCERTAINTY), drivable.objective_names
    )
    found = ho.recommend(ho.Front.of(unsure, front.x[:2]), alone=True)
    assert not found.fits
    assert not found.warnings
    assert " 120.0 N" in found.objection
    headline, allowed, *_ = repr(found).splitlines()
    assert headline[1:] == found.objection[1:]
    assert f" {found.required.max():.1f} N" in allowed
    assert f" {found.duration:.3f} s" in allowed
    # As fast as with arms that are strong enough: not the slowest because it is the gentlest.
    stronger = ho.recommend(
        ho.Front.of(unsure, front.x[:2]),
        ho.Wish(reference_force=found.required.max()),
        alone=True,
    )
    assert stronger.fits
    assert stronger.duration == pytest.approx(found.duration, rel=0.02)
    felt = max(
        each.max() for each in robust_model(unsure.workcell).hold(found.carry, USUAL_UNCERTAINTY)
    )
    assert found.required.max() == pytest.approx(felt, rel=5e-3)
    assert len(found.remedies) == 3
    assert [abs(each.share) for each in found.remedies] == sorted(
        abs(each.share) for each in found.remedies
    )


def test_wishes_that_nothing_answers_say_what_is_possible(
    drivable: ho.Cell, front: ho.Front
) -> None:
    with refused(SettingsError, "too-short"):
        ho.recommend(front, ho.Wish(duration=0.5))
    with pytest.raises(SettingsError, match=r" 9\d\.\d N "):
        ho.recommend(front, ho.Wish(force=40.0))
    with pytest.raises(SettingsError, match=r"30 kg.* 147"):
        ho.recommend(front, ho.Wish(payload=30.0))
    with refused(SettingsError, "empty-front"):
        ho.recommend(replace(front, x=np.zeros((0, 19))))
    with refused(SettingsError, "not-drivable"):
        ho.recommend(replace(front, cell=cells.shipped("rack")))


@pytest.mark.parametrize(
    "values",
    [
        {"duration": 2.0, "force": 52.0},
        {"duration": 0.0},
        {"payload": float("nan")},
        {"reference_force": -1.0},
    ],
)
def test_odd_wishes_are_refused(values: dict[str, Any]) -> None:
    with pytest.raises(SettingsError):
        ho.Wish(**values)


def test_a_front_is_as_fast_as_its_fastest_member(drivable: ho.Cell, front: ho.Front) -> None:
    """Within a commanded force, which grows with the multiple of what holds still in every case."""
    forces = table_forces(drivable.workcell)
    still = ho.grip_budget(drivable.workcell).required.max()
    allowed = drivable.workcell.task.reference_force.max()
    expected = [m * still for m in (1.02, 1.04, 1.06, 1.08, 1.12, 1.2) if m * still < allowed]
    assert forces == pytest.approx(np.array([*expected, allowed]), rel=1e-3)
    members = front.x[spread_rows(front.x[:, :-1])][:2]
    limits = members[:, -1]
    whole = commanded_durations(DrivenPaths(drivable, members[:, :-1]), limits, forces)
    alone = [
        commanded_durations(DrivenPaths(drivable, x[None, :-1]), x[-1], forces) for x in members
    ]
    np.testing.assert_array_equal(whole, np.min(alone, axis=0))
    assert (np.diff(whole[np.isfinite(whole)]) <= 1e-9).all(), "more force, less time"


def test_the_reserve_is_used_up_at_the_reference_force(
    drivable: ho.Cell, found: Recommendation
) -> None:
    """By the forces of the changed cells, found anew."""
    payload, allowed = drivable.workcell.payload, found.budget.allowed.max()
    assert payload.mass < found.reserve.payload < found.carry.payload_limit
    assert found.reserve.friction < drivable.workcell.contacts[0].friction
    factor = found.reserve.payload / payload.mass
    heavier = replace(payload, mass=factor * payload.mass, inertia=factor * payload.inertia)
    first, second = (
        replace(pad, friction=found.reserve.friction) for pad in drivable.workcell.contacts
    )
    for cell in (
        replace(drivable.workcell, payload=heavier),
        replace(drivable.workcell, contacts=(first, second)),
    ):
        held = robust_model(cell).hold(found.carry, cell.uncertainty)
        assert max(each.max() for each in held) == pytest.approx(allowed, rel=5e-3)


def test_options_are_those_of_the_independent_timing(drivable: ho.Cell, front: ho.Front) -> None:
    paths = DrivenPaths(drivable, front.x[:2, :-1])
    option = paths.options(57.0, [1])[0]
    timing = timed(drivable, front.x[1, :-1], 57.0)
    assert (option.index, option.limit) == (1, 57.0)
    assert option.duration == pytest.approx(timing.duration, rel=0.02)
    assert option.commanded == pytest.approx(held(drivable, timing.carry).max(), rel=0.02)


def test_a_drivable_cell_is_the_same_cell(drivable: ho.Cell) -> None:
    cell = cells.shipped("rack")
    assert drivable.objective_names == ("duration", "peak_force")
    own, task = drivable.workcell.task, cell.workcell.task
    (path,) = resample_decisions(drivable.initial[:-1], own, task)
    np.testing.assert_allclose(path, cell.initial, atol=1e-12)
    assert drivable.workcell.source.is_file()
    assert not drivable.force_kind.robust
    assert ho.Cell.load(RACK, ROBUST_OBJECTIVES).drivable().force_kind.robust


PLACES: dict[str, dict[str, list[float]]] = {
    "drum": {
        "contacts[0].xyz": [-0.0439992377, 0.1642073905, 0.07],
        "contacts[1].xyz": [-0.0439992377, -0.1642073905, 0.07],
    },
    "fork": {
        "contacts[0].xyz": [-0.08, 0.20, 0.055],
        "contacts[0].further[0].xyz": [0.08, 0.20, 0.055],
        "contacts[1].xyz": [0.0, -0.20, 0.055],
    },
}
WIDER: dict[str, dict[str, list[float]]] = {
    "drum": {"contacts.patch_size": [0.062, 0.032]},
    "fork": {"contacts[0].patch_size": [0.032, 0.032], "contacts[1].patch_size": [0.052, 0.052]},
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["fork", "drum"])
def test_changes_of_pads_anywhere_are_those_of_the_file(name: str) -> None:
    workcell, moved = model(name).workcell, motion(name)
    told = dict(changes_of_cell(workcell, moved))

    def force(changes: dict[str, Any]) -> float:
        """Largest that holds every case with other numbers in the file [N]."""
        cell = changed(workcell, changes | {"task.allocation": "soft-finger"})
        return float(RobustModel(replace(cell, uncertainty=SET)).hold(moved, SET)[0].max())

    def lower(by: float) -> dict[str, list[float]]:
        return {path: [x, y, z - by] for path, (x, y, z) in PLACES[name].items()}

    now = force({})
    files: dict[str, dict[str, Any]] = {
        "friction 0.05 higher": {"contacts.friction": 0.85},
        "patches 1 mm wider to each side": dict(WIDER[name]),
        "pads 1 mm lower": dict(lower(1e-3)),
    }
    for change, numbers in files.items():
        assert told[change] == pytest.approx(force(numbers) - now, rel=1e-3)
    height = 1e3 * (PLACES[name]["contacts[0].xyz"][2] - workcell.payload.centre_of_mass[2])
    level = f"pads at the height of the centre of mass, now {height:.0f} mm above it"
    assert told[level] == pytest.approx(force(lower(height / 1e3)) - now, rel=1e-3)
    assert all(change < 0.0 for change in told.values())


@pytest.mark.slow
def test_hands_that_hold_by_themselves_are_recommended_with_a_job() -> None:
    cell = ho.example("palletising").drivable()
    front = ho.search(cell, "nsga2", evaluations=150, rng=np.random.default_rng(1))
    found = ho.recommend(front)
    assert found.fits
    assert (found.required <= cell.workcell.task.reference_force).all()
    assert found.squeeze.force == pytest.approx(sum(part.force for part in found.squeeze.parts))
    text = repr(found)
    assert f"{found.duration:.3f} s" in text
    assert f"{found.force:.1f} N" in text
    assert not any("lower" in each.change for each in found.advice), "cups lie on the top"
    assert found.job is not None
    np.testing.assert_allclose(found.job.peak_normal_force, found.force, rtol=0.01)
    # A larger cup needs less, and its vacuum holds with more.
    told = {each.change: each.force for each in found.advice}
    _, moved = subsample(found.carry)
    radius, force = {"contacts.patch_radius": 0.035}, {"contacts.holding_force": 140.0 * 49 / 36}
    other = changed(cell.workcell, radius | force)
    needs = robust_model(other).commanded(moved, cell.workcell.uncertainty, 0).max() * 36 / 49
    now = robust_model(cell.workcell).commanded(moved, cell.workcell.uncertainty, 0).max()
    larger = told["cups 10 mm larger across at the same vacuum"]
    assert larger == pytest.approx(needs - now, rel=1e-3)
    assert larger < 5.0 * told["patches 1 mm wider to each side"]
    # Half the force does not hold a case of the uncertainty: the command is not too high.
    needed = robust_model(cell.workcell).commanded(moved, cell.workcell.uncertainty, 0)
    assert 0.5 * found.force < needed.max() <= found.force * 1.001
