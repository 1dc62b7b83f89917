"""What is commanded of a carry never falls below what is needed, and what robustness costs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybrid_opt.carry import BoxMotion, Carry
from hybrid_opt.robust.force import SAMPLES, RobustModel, robust_model, subsample
from hybrid_opt.robust.price import robust_price
from hybrid_opt.robust.squeeze import (
    UNCERTAINTY_SOURCES,
    Squeeze,
    SqueezeSettings,
    commanded_forces,
    extra_normal_force,
    smooth_above,
)
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.read.cell import load
from symbolic.records import USUAL_UNCERTAINTY, Uncertainty, Workcell
from tests.hybrid_opt.job.jobs import rack, rack_job, rack_jobs, rack_timing
from tests.symbolic.cells import RACK

FORCES = st.lists(st.floats(0.0, 200.0), min_size=2, max_size=40)


@given(FORCES, st.floats(0.05, 5.0), st.floats(0.01, 0.5))
def test_the_smoothed_curve_is_nowhere_below(
    forces: list[float], duration: float, width: float
) -> None:
    time = np.linspace(0.0, duration, len(forces))
    smooth = smooth_above(time, np.array(forces), width)
    assert (smooth >= np.array(forces) - 1e-9).all()
    assert smooth.max() <= max(forces) + 1e-9


def test_a_jump_becomes_a_smooth_rise_before_it() -> None:
    time = np.array([0.0, 0.5, 0.5, 1.0])
    grid = np.linspace(0.0, 1.0, 1001)
    step = np.interp(grid, time, [50.0, 50.0, 60.0, 60.0])
    smooth = smooth_above(grid, step, 0.1)
    assert smooth[290] == pytest.approx(50.0)
    assert smooth[510] == pytest.approx(60.0)
    # Kernel of (1 - s^2)^3 over 0.2 s: its largest value times the jump bounds the rate.
    assert np.gradient(smooth, grid).max() < 10.0 * 1.2 / 0.1
    assert abs(np.gradient(smooth, grid)[[1, -2]]).max() < 1e-6


def test_the_factor_multiplies_the_squeeze() -> None:
    job = rack_jobs().plan(rack_timing(), SqueezeSettings(1.3))
    assert str(job.squeeze).startswith("1.3 ")
    assert job.squeeze.force == pytest.approx(job.peak_normal_force[1], rel=1e-9)
    for phase in job.phases:
        if phase.name in ("lift", "carry", "set_down"):
            least, normal = phase.force.least, phase.force.normal
            assert (normal >= least - 1e-9).all()
            assert (normal.sum(axis=1) >= 1.3 * least.sum(axis=1) - 1e-9).all()
            # The motion fixes the difference of both forces, whatever the squeeze.
            np.testing.assert_allclose(
                normal[:, 0] - normal[:, 1], least[:, 0] - least[:, 1], atol=1e-9
            )


def rack_carry() -> Carry:
    carry = rack_job().timing.driven
    return carry


def pressed(uncertainty: Uncertainty) -> tuple[Workcell, Array, Squeeze]:
    """The rack under a set, what is commanded of arm 2 along its carry, and why."""
    cell, carry = replace(rack().workcell, uncertainty=uncertainty), rack_carry()
    forces, squeeze = commanded_forces(cell, carry, SqueezeSettings())
    return cell, forces[:, 1], squeeze


SET = Uncertainty(
    0.2, 0.05, np.full(3, 0.005), 0.003, np.full(3, 0.2), 0.1, 5.0, 0.02, 0.004, 0.005
)


def test_an_uncertain_cell_is_pressed_for_every_case() -> None:
    cell, commanded, squeeze = pressed(SET)
    carry = rack_carry()
    needed = robust_model(cell).hold(carry, SET)[0]
    assert (commanded >= needed - 1e-6).all()
    assert commanded.max() == pytest.approx(needed.max(), abs=1e-6)
    assert "[uncertainty]" in str(squeeze)


def test_the_force_is_the_sum_of_its_parts() -> None:
    """At rest and level each part is known in closed form: mass, friction, tilt and places scale
    the force, the arms' own force adds to it, tracking scales both."""
    cell = replace(rack().workcell, uncertainty=replace(SET, centre_of_mass=np.zeros(3)))
    still = BoxMotion(np.zeros((2, 6)), np.zeros((2, 6)), np.zeros((2, 6)))
    extra, squeeze = extra_normal_force(
        cell, SqueezeSettings(), np.array([0.0, 1.0]), still, np.zeros((2, 2))
    )
    parts = {part.name: part.force for part in squeeze.parts}
    assert list(parts) == [
        "least force",
        *[name for name in UNCERTAINTY_SOURCES if name != "centre of mass"],
    ]
    assert extra.max() == pytest.approx(sum(parts.values()))
    weight = 10.0 * 9.81 / 2.0
    assert parts["least force"] == pytest.approx(weight, rel=1e-6)
    assert parts["friction"] == pytest.approx(weight / 0.8 - weight, rel=1e-6)
    assert parts["mass"] == pytest.approx(0.05 * weight / 0.8, rel=1e-6)
    mu = np.tan(np.arctan(0.8) - 0.025) - (2.0 * 0.003 + 0.004) / 0.4
    assert parts["arms against one another"] == pytest.approx(5.0 / mu, rel=1e-6)
    assert parts["tracking"] == pytest.approx(squeeze.force * 0.1, rel=1e-6)
    assert squeeze.breakdown.endswith(f"tracking = {squeeze.force:.1f} N")


def test_a_stated_stiffness_makes_a_force_of_the_arms_places() -> None:
    stiff = Uncertainty(relative_position=0.001, stiffness=2e4)
    assert stiff.opposed_force == 10.0
    _, soft_sided, _ = pressed(Uncertainty(relative_position=0.001))
    _, commanded, _ = pressed(stiff)
    _, same, _ = pressed(Uncertainty(internal_force=10.0))
    np.testing.assert_allclose(commanded, same)
    assert commanded.max() > soft_sided.max() + 9.0


def test_a_cell_that_states_nothing_is_pressed_for_the_usual_set() -> None:
    _, commanded, squeeze = pressed(USUAL_UNCERTAINTY)
    assert "usual" in str(squeeze)
    _, least, told = pressed(Uncertainty())
    assert [part.name for part in told.parts] == ["least force"]
    assert commanded.max() > 1.5 * least.max()


@pytest.mark.parametrize(
    "arguments", [{"factor": 0.9}, {"factor": 100.0}, {"leader": 2}, {"smoothing": 0.0}]
)
def test_settings_are_checked(arguments: dict[str, float]) -> None:
    with pytest.raises(SettingsError):
        SqueezeSettings(**arguments)  # type: ignore[arg-type]


CASES = 2000
PRICED = Uncertainty(friction=0.15, centre_of_mass=np.array([0.0, 0.004, 0.0]))


def test_a_carry_is_priced_under_its_cells_own_set() -> None:
    cell = replace(rack().workcell, uncertainty=PRICED)
    carry = replace(rack_carry(), workcell=cell)
    found = robust_price(RobustModel(cell), carry, np.random.default_rng(1), cases=CASES)
    assert found.uncertainty is PRICED
    at_one = found.peak[found.factors == 1.0][0]
    np.testing.assert_allclose(found.commanded, at_one)
    assert (np.diff(found.peak, axis=0) > 0.0).all()
    assert found.check.cases == CASES
    assert found.check.holds
    assert 0.97 <= found.check.closest <= 1.0
    # Both sides of the largest set, by the curve: forces grow with the factor.
    below = found.factors <= found.largest_factor
    assert (found.peak[below] <= found.limit).all()
    assert not (found.peak[~below] <= found.limit).all(axis=1).any()


def test_the_largest_forces_are_among_the_thinned_samples() -> None:
    carry = rack_carry()
    _, motion = subsample(carry)
    assert SAMPLES <= len(motion.pose) <= SAMPLES + 2
    for row in carry.normal_force.argmax(axis=0):
        assert (motion.pose == carry.pose[row]).all(axis=1).any()


@pytest.mark.parametrize("settings", [SqueezeSettings(), SqueezeSettings(1.0)])
@pytest.mark.parametrize("name", ["rack", "corner"])
def test_what_is_commanded_holds_even_pads(name: str, settings: SqueezeSettings) -> None:
    """Although the plan, here none at all, asks for less."""
    cell, still = load(RACK.with_name(f"{name}.toml")), BoxMotion(*[np.zeros((2, 6))] * 3)
    model, time = robust_model(cell), np.array([0.0, 1.0])
    extra, _ = extra_normal_force(cell, settings, time, still, np.zeros((2, 2)))
    assert (extra >= model.nominal(still)[:, 1] * (1.0 - 1e-9)).all()
