"""Robust forces of pads that are not two round ones facing one another, or that press evenly."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from codegen.lanes import lane_text
from codegen.source import dense, generated_c
from hybrid_opt.robust.cases import nominal_case, random_cases
from hybrid_opt.robust.force import (
    LARGEST_FACTOR,
    SAMPLES,
    BoxMotion,
    RobustModel,
    allowed_factor,
    closes_evenly,
    soft_model,
)
from hybrid_opt.robust.squeeze import SqueezeSettings, pressed_beyond
from symbolic.contact.worst_cases import CASE_SIZES, case_grasp_function
from symbolic.errors import SettingsError
from symbolic.read.cell import load
from symbolic.records import Allocation, Uncertainty, Workcell
from tests.hybrid_opt.robust.test_force import at_rest
from tests.symbolic.cells import RACK, ROOT, rack_cell

SET = Uncertainty(0.08, 0.05, np.full(3, 0.004), 0.003, np.array([0.2, 0.0, 0.3]))
NAMES = ["drum", "fork", pytest.param("corner", marks=pytest.mark.slow)]


@cache
def model(name: str, allocation: Allocation = "joint") -> RobustModel:
    cell = load(ROOT / "studies" / "workcells" / f"{name}.toml")
    task = replace(cell.task, allocation=allocation)
    return RobustModel(replace(cell, uncertainty=SET, task=task))


def test_pads_that_press_evenly_hold_displaced_too() -> None:
    """And need more than pads that choose their pressure."""
    even, moved = model("drum", "soft-finger"), motion("drum")
    force = even.robust_force(moved)
    assert (force.commanded > force.nominal[:, 1]).all()
    assert (force.nominal[:, 1] > model("drum").robust_force(moved).nominal[:, 1]).all()
    assert even.check(moved, force, 200, np.random.default_rng(1)).holds
    weaker = replace(force, commanded=0.85 * force.commanded)
    assert not even.check(moved, weaker, 200, np.random.default_rng(1)).holds


@pytest.mark.parametrize("name", NAMES)
def test_more_friction_never_needs_more_force(name: str) -> None:
    """And a force is found wherever friction closes the grasp, far from the cell's own too."""
    even, shares = model(name, "soft-finger"), np.linspace(0.7, 1.3, 61)
    cases = np.tile(nominal_case(even.workcell), (len(shares), 1))
    assert next(iter(CASE_SIZES)) == "friction"
    cases[:, : CASE_SIZES["friction"]] *= shares[:, None]
    force = even.least_squeeze(motion(name), cases)
    assert np.isfinite(force).all()
    assert (np.diff(force, axis=0) < 1e-6 * force[1:]).all()


def test_what_is_commanded_is_known_without_every_case() -> None:
    even, moved = model("drum", "soft-finger"), motion("drum")
    commanded, leading = even.hold(moved, SET)
    np.testing.assert_allclose(even.commanded(moved, SET), commanded, rtol=1e-9)
    above = float(np.median(commanded))
    found = even.commanded(moved, SET, above=above)
    np.testing.assert_allclose(found, np.maximum(commanded, above), rtol=1e-9)
    np.testing.assert_allclose(even.peak(moved, SET), [leading.max(), commanded.max()], rtol=5e-3)


def test_a_set_that_no_found_force_holds_is_told() -> None:
    """Nearly no friction is left: the forces of a fork are not found."""
    even, moved = model("fork", "soft-finger"), motion("fork")
    widest = even.largest_factor(moved, np.full(2, 1e9))
    assert 0.0 < widest < LARGEST_FACTOR
    lost = SET.scaled(allowed_factor(even.workcell, SET))
    assert np.isinf(even.peak(moved, lost)).all()
    with pytest.raises(SettingsError, match="no force was found that holds every case"):
        even.robust_force(moved, lost)


def test_of_many_samples_those_between_are_held_too() -> None:
    """More than `SAMPLES` of them: cases that rule at some are asked at all."""
    even, few = model("drum", "soft-finger"), motion("drum")
    at, share = np.arange(6.0), np.linspace(0.0, 5.0, 2 * SAMPLES)
    parts = [
        np.column_stack([np.interp(share, at, column) for column in values.T])
        for values in vars(few).values()
    ]
    moved = BoxMotion(*parts)
    np.testing.assert_allclose(even.commanded(moved, SET), even.hold(moved, SET)[0], rtol=1e-4)


def test_cases_of_pads_anywhere_are_evaluated_in_lanes() -> None:
    """Of a form without lanes a recommendation would take minutes."""
    function = dense(case_grasp_function(model("drum", "soft-finger").workcell, 1))
    assert lane_text(generated_c([function]), "lanes").entry


def motion(name: str) -> BoxMotion:
    """Around the cell's start pose, gently."""
    task = model(name).workcell.task
    rng, n = np.random.default_rng(2), 6
    pose = np.tile(task.waypoints[0].lower, (n, 1)) + 0.05 * rng.normal(size=(n, 6))
    return BoxMotion(pose, 0.2 * rng.normal(size=(n, 6)), 0.5 * rng.normal(size=(n, 6)))


@pytest.mark.parametrize("name", NAMES)
def test_no_random_case_needs_more_and_some_need_nearly_as_much(name: str) -> None:
    moved = motion(name)
    force = model(name).robust_force(moved)
    assert (force.commanded > force.nominal[:, 1]).all()
    check = model(name).check(moved, force, 400, np.random.default_rng(1))
    assert check.holds
    weaker = replace(force, commanded=0.85 * force.commanded)
    assert not model(name).check(moved, weaker, 400, np.random.default_rng(1)).holds


def test_a_fork_and_a_pad_press_alike() -> None:
    """Opposite normals: what the motion asks along them is the difference, all else is squeeze."""
    force = model("fork").robust_force(at_rest(), Uncertainty(friction=0.1))
    cell = model("fork").workcell
    least = 9.81 * cell.payload.mass / (2.0 * 0.9 * cell.contacts[0].friction)
    assert force.leading == pytest.approx(force.commanded, rel=2e-3)
    assert force.commanded[0] >= least * (1.0 - 1e-6)


EVEN = Uncertainty(
    friction=0.2,
    mass=0.05,
    centre_of_mass=np.full(3, 0.01),
    pad_position=0.005,
    disturbance=np.full(3, 0.3),
)


def motions(rng: np.random.Generator, n: int = 30) -> BoxMotion:
    pose = np.column_stack([rng.uniform(-0.5, 0.5, (n, 3)), rng.uniform(-0.4, 0.4, (n, 3))])
    return BoxMotion(pose, rng.uniform(-0.5, 0.5, (n, 6)), rng.uniform(-3.0, 3.0, (n, 6)))


@pytest.fixture(scope="module")
def rack() -> Workcell:
    return rack_cell()


def test_no_random_case_needs_more(rack: Workcell) -> None:
    model, rng = soft_model(rack), np.random.default_rng(1)
    motion = motions(rng)
    commanded, _ = model.hold(motion, EVEN)
    needed = model.least_squeeze(motion, random_cases(rack, EVEN, 4000, rng))[:, :, 1]
    share = (needed / commanded).max()
    assert 0.75 < share <= 1.0


@pytest.mark.parametrize("settings", [SqueezeSettings(), SqueezeSettings(1.0)])
def test_what_is_commanded_holds_even_pads(rack: Workcell, settings: SqueezeSettings) -> None:
    """Although the plan, here none at all, asks for less."""
    model, motion = soft_model(rack), motions(np.random.default_rng(3))
    time, planned = np.linspace(0.0, 2.0, 30), np.zeros((30, 2))
    extra, squeeze = pressed_beyond(rack, settings, time, motion, planned)
    assert (extra >= model.nominal(motion)[:, 1] * (1.0 - 1e-9)).all()
    assert "press evenly" in str(squeeze)


def test_pads_that_only_choosing_their_pressure_would_close_are_told() -> None:
    cell, still = load(RACK.with_name("corner.toml")), BoxMotion(*[np.zeros((2, 6))] * 3)
    slippery = [replace(contact, friction=0.9) for contact in cell.contacts]
    assert closes_evenly(cell)
    assert not closes_evenly(replace(cell, contacts=(slippery[0], slippery[1])))
    time = np.array([0.0, 1.0])
    _, squeeze = pressed_beyond(cell, SqueezeSettings(), time, still, np.zeros((2, 2)))
    assert "press evenly" in str(squeeze)
