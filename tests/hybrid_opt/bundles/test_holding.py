"""Efforts with and without gravity against Pinocchio, stops against the forces that they need."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from hybrid_opt.bundles.job_file import between, chosen_step, gap_of, pad_errors, stop_of
from hybrid_opt.errors import JobError
from hybrid_opt.job.compliance import HELD, TRACKED
from hybrid_opt.job.records import Job, sample_job
from symbolic.errors import SettingsError
from tests.hybrid_opt.bundles.bundles import exported, text_of
from tests.hybrid_opt.job.jobs import rack, rack_job


def test_gravity_is_that_of_the_description() -> None:
    """The bundle's own URDF, read by Pinocchio."""
    model = pin.buildModelFromXML(text_of("ros2-control", "description/cell.urdf"))
    data, found = model.createData(), exported("ros2-control")
    for k in range(0, len(found.sampled.time), 20):
        gravity = pin.computeGeneralizedGravity(model, data, found.sampled.q[k])
        np.testing.assert_allclose(found.efforts.gravity[k], gravity, atol=1e-2)


def test_holding_bears_half_of_the_box_each_and_presses() -> None:
    """Virtual work: what holding efforts beside gravity do along each joint is what the pad's
    wrench does along the pad's way; both wrenches together bear the box."""
    found = exported("ros2-control")
    sampled, cell = found.sampled, rack().workcell
    load = found.efforts.holding - found.efforts.gravity
    model = pin.buildModelFromXML(text_of("ros2-control", "description/cell.urdf"))
    data = model.createData()
    span = sampled.span([p.name for p in sampled.job.phases].index("carry"))
    for k in range(span.start, span.stop, 15):
        total = np.zeros(3)
        for arm, name in enumerate(("left_contact_pad", "right_contact_pad")):
            frame = model.getFrameId(name)
            J = pin.computeFrameJacobian(model, data, sampled.q[k], frame, pin.LOCAL_WORLD_ALIGNED)
            pin.framesForwardKinematics(model, data, sampled.q[k])
            part = slice(6 * arm, 6 * arm + 6)
            wrench = np.linalg.solve(J[:, part].T, load[k, part])
            normal = data.oMf[frame].rotation[:, 2]
            assert wrench[:3] @ normal == pytest.approx(sampled.normal_force[k, arm], rel=0.02)
            total += wrench[:3]
        np.testing.assert_allclose(total, [0.0, 0.0, 9.81 * cell.payload.mass], atol=0.2)


def test_at_rest_holding_is_moving() -> None:
    found = exported("ros2-control")
    last = np.array(found.sampled.last)
    np.testing.assert_allclose(found.efforts.moving[last], found.efforts.holding[last], atol=1e-6)


def test_a_stop_keeps_the_squeeze() -> None:
    job = rack_job()
    stop = stop_of(job)
    assert stop.force_use <= 1.0
    weak = [replace(p, force=replace(p.force, normal=0.4 * p.force.normal)) for p in job.phases]
    with pytest.raises(JobError, match="of the commanded forces: press more"):
        stop_of(replace(job, phases=tuple(weak)))


def test_a_stop_needs_the_force_of_its_deceleration() -> None:
    """The worst stop of the job by hand: F = m (a - g), least forces with a Coulomb cone."""
    job, cell = rack_job(), rack().workcell
    stop = stop_of(job)
    mu = min(contact.friction for contact in cell.contacts)
    worst = 0.0
    for phase in job.phases:
        if phase.name not in HELD:
            continue
        motion = phase.motion
        # A bound: full speed and the largest slope of the rate at once, whole planned acceleration.
        slope = 1.875 / stop.time
        second = np.abs(motion.second_rate[:, :3]) + slope * np.abs(motion.rate[:, :3])
        size = np.linalg.norm(second, axis=1) + 9.81
        worst = max(worst, float((cell.payload.mass * size / (2.0 * mu)).max()))
    commanded = min(float(p.force.normal.min()) for p in job.phases if p.name in HELD)
    # Soft fingers and moments ask for more than the cone alone.
    assert stop.force_use <= 1.6 * worst / commanded


def independent_gap(job: Job, step: float, kind: str) -> float:
    """Largest change of the gap [m] by polynomials of our own between the samples."""
    sampled = sample_job(job, step)
    worst = 0.0
    for index, phase in enumerate(job.phases):
        if phase.name not in HELD:
            continue
        span = sampled.span(index)
        for k in range(span.start, span.stop - 1, 3):
            h = sampled.time[k + 1] - sampled.time[k]
            ends = [
                [sampled.q[i], sampled.q_rate[i] * h, sampled.q_second[i] * h * h]
                for i in (k, k + 1)
            ]
            n = {"linear": 1, "cubic": 2, "quintic": 3}[kind]
            rows, values = [], []
            for x, known in zip((0.0, 1.0), ends, strict=True):
                for d in range(n):
                    p = np.polynomial.polynomial
                    row = [p.polyval(x, p.polyder(np.eye(2 * n)[c], d)) for c in range(2 * n)]
                    rows.append(row)
                    values.append(known[d])
            c = np.linalg.solve(np.array(rows), np.array(values))
            q = np.array([sum(c[j] * 0.5**j for j in range(2 * n))])
            along, _ = pad_errors(job.workcell, q)
            worst = max(worst, float(np.abs(along).max()))
    return worst


@pytest.mark.parametrize(("kind", "step"), [("linear", 0.2), ("cubic", 0.2), ("quintic", 0.2)])
def test_the_gap_is_that_of_an_independent_interpolation(kind: str, step: float) -> None:
    found = gap_of(sample_job(rack_job(), step), kind, 1e4)  # type: ignore[arg-type]
    expected = independent_gap(rack_job(), step, kind)
    assert found.along == pytest.approx(expected, rel=0.5, abs=1e-9)
    assert found.force == pytest.approx(1e4 / 2.0 * found.along)


def test_the_step_follows_from_the_stiffness() -> None:
    steps = (0.2, 0.1, 0.05, 0.02)
    soft = chosen_step(rack_job(), steps, "linear", 2e3)
    stiff = chosen_step(rack_job(), steps, "linear", 1e5)
    assert soft > stiff
    assert gap_of(sample_job(rack_job(), stiff), "linear", 1e5).share <= TRACKED
    longer = steps[steps.index(stiff) - 1]
    assert gap_of(sample_job(rack_job(), longer), "linear", 1e5).share > TRACKED
    with pytest.raises(SettingsError, match="the gap of the pads is wrong by"):
        chosen_step(rack_job(), (0.2,), "linear", 1e6)


def test_samples_themselves_hold_the_box() -> None:
    sampled = exported("ros2-control").sampled
    for kind in ("linear", "cubic", "quintic"):
        q = between(sampled, kind, sampled.time)
        np.testing.assert_allclose(q, sampled.q, atol=1e-12)
