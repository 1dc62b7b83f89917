"""Durations against an independent convex program and an independent nonlinear one."""

from __future__ import annotations

import numpy as np
import pytest

from hybrid_opt.timing import TimingLimits, time_path
from tests.hybrid_opt.timing import convex_oracle, nonlinear_oracle
from tests.hybrid_opt.timing.cells import hand_timing, near_initial, timing_of, with_robots
from tests.symbolic.cells import hand_cell

FORCE_SHARES = (None, 1.005, 1.05, 1.2)
"""Force limits over the largest force at rest."""

SEEDS = [pytest.param(seed, marks=pytest.mark.slow if seed >= 6 else ()) for seed in range(24)]


@pytest.mark.parametrize("seed", SEEDS)
def test_duration_agrees_with_a_convex_program(seed: int) -> None:
    model = hand_timing()
    (x,) = near_initial(np.random.default_rng(seed), 1)
    motion = model.path_motion(x)
    still = np.zeros(len(motion.parameter))
    static = float(model.drive(motion, still, still)["normal_force"].max())
    share = FORCE_SHARES[seed % len(FORCE_SHARES)]
    limits = TimingLimits(
        force=None if share is None else share * static,
        torque=False,
        pressure=False,
        reference_speed=seed % 3 == 0,
    )
    timing = time_path(model, x, limits)
    assert timing.ok, timing.reason
    # Asked for is 1 %; the two agree much better.
    assert timing.duration == pytest.approx(
        convex_oracle.shortest_duration(model, x, limits), rel=1e-3
    )


@pytest.mark.parametrize("factor", [0.6, 0.55])
@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))]
)
def test_torque_limited_duration_agrees_with_a_nonlinear_program(factor: float, seed: int) -> None:
    model = timing_of(with_robots(hand_cell(), torque_max=factor), intervals=40)
    (x,) = near_initial(np.random.default_rng(seed), 1, size=0.5)
    timing = time_path(model, x, TimingLimits(pressure=False))
    assert timing.ok, timing.reason
    assert timing.use["joint torque"].ratio == pytest.approx(1.0, abs=0.005)
    assert timing.grid_speed is not None
    exact = nonlinear_oracle.shortest_duration(model, x, start=0.7 * timing.grid_speed)
    assert timing.duration == pytest.approx(exact, rel=0.01)
    without = time_path(model, x, TimingLimits(pressure=False, torque=False))
    assert timing.duration > 1.01 * without.duration
