"""CSV and JSON read back, by others too, and the samples that they hold."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Callable
from typing import Any

import jsonschema
import numpy as np
import pytest

from hybrid_opt.job.records import SampledJob, sample_job
from symbolic.errors import SettingsError
from tests.hybrid_opt.bundles.bundles import exported, text_of
from tests.hybrid_opt.job.jobs import rack_job


def sampled() -> SampledJob:
    return exported("csv").sampled


def test_samples_lie_on_the_job() -> None:
    found = sampled()
    assert found.time[0] == 0.0
    assert found.time[-1] == pytest.approx(rack_job().duration)
    assert (np.diff(found.time) > 0.0).all()
    assert np.diff(found.time).max() <= 0.05 + 1e-12
    for index, phase in enumerate(rack_job().phases):
        span = found.span(index)
        begin, end = found.time[span.start], found.time[span.stop - 1]
        assert begin == pytest.approx(phase.begin)
        assert end == pytest.approx(phase.begin + phase.duration)
        np.testing.assert_allclose(found.q_rate[[span.start, span.stop - 1]], 0.0, atol=1e-9)
        np.testing.assert_allclose(found.q_second[span.stop - 1], 0.0, atol=1e-9)
        for k in range(span.start, span.stop, 7):
            near = int(np.argmin(np.abs(phase.motion.time + phase.begin - found.time[k])))
            offset = found.time[k] - phase.begin - phase.motion.time[near]
            expected = phase.motion.q[near] + offset * phase.motion.q_rate[near]
            np.testing.assert_allclose(found.q[k], expected, atol=5e-5)
            np.testing.assert_allclose(found.effort[k], phase.effort[near], atol=1.0)


def test_samples_are_consistent_with_their_derivatives() -> None:
    fine = sample_job(rack_job(), 0.002)
    slope = (fine.q[2:] - fine.q[:-2]) / (fine.time[2:] - fine.time[:-2])[:, None]
    np.testing.assert_allclose(slope, fine.q_rate[1:-1], atol=5e-4)


def test_csv_read_back() -> None:
    rows = list(csv.DictReader(io.StringIO(text_of("csv", "job.csv"))))
    job = sampled()
    assert len(rows) == len(job.time)
    assert len(rows[0]) == 2 + 6 + 60 + 2 + 12
    for k, row in enumerate(rows):
        assert float(row["time [s]"]) == job.time[k]
        assert row["phase"] == job.phase_names[k]
        assert float(row["right/joint_4 position [rad]"]) == job.q[k, 9]
        assert float(row["left/joint_1 velocity [rad/s]"]) == job.q_rate[k, 0]
        assert float(row["right/joint_6 acceleration [rad/s^2]"]) == job.q_second[k, 11]
        assert float(row["left/joint_2 effort with gravity [N m]"]) == job.effort[k, 1]
        less = job.effort[k, 1] - exported("csv").efforts.gravity[k, 1]
        assert float(row["left/joint_2 effort without gravity [N m]"]) == less
        assert float(row["box z [m]"]) == job.pose[k, 2]
        assert float(row["left normal force [N]"]) == job.normal_force[k, 0]
        assert float(row["right wrench fy [N]"]) == job.wrench[k, 1, 1]
    names = [row["phase"] for row in rows]
    assert list(dict.fromkeys(names)) == [phase.name for phase in rack_job().phases]


def test_json_read_back() -> None:
    document, job = json.loads(text_of("json", "job.json")), sampled()
    assert document["format"] == "dual-arm-carry job"
    np.testing.assert_array_equal(document["time"], job.time)
    np.testing.assert_array_equal(document["box"]["pose"], job.pose)
    assert [phase["name"] for phase in document["phases"]] == [p.name for p in rack_job().phases]
    for phase, planned in zip(document["phases"], rack_job().phases, strict=True):
        assert job.time[phase["first"]] == pytest.approx(planned.begin)
    for i, robot in enumerate(document["robots"]):
        assert robot["name"] == rack_job().workcell.robots[i].name
        assert robot["joints"] == [f"joint_{k}" for k in range(1, 7)]
        columns = slice(6 * i, 6 * i + 6)
        np.testing.assert_array_equal(robot["position"], job.q[:, columns])
        np.testing.assert_array_equal(robot["velocity"], job.q_rate[:, columns])
        np.testing.assert_array_equal(robot["acceleration"], job.q_second[:, columns])
        np.testing.assert_array_equal(robot["effort_with_gravity"], job.effort[:, columns])
        np.testing.assert_array_equal(robot["normal_force"], job.normal_force[:, i])


def test_the_schema_describes_the_file() -> None:
    schema = json.loads(text_of("json", "job.schema.json"))
    jsonschema.Draft202012Validator.check_schema(schema)
    document = json.loads(text_of("json", "job.json"))
    jsonschema.validate(document, schema, jsonschema.Draft202012Validator)
    broken: list[Callable[[Any], object]] = [
        lambda d: d.update(version=1),
        lambda d: d.pop("machine"),
        lambda d: d["robots"].pop(),
        lambda d: d["robots"][0].pop("effort_without_gravity"),
        lambda d: d["robots"][0].update(effort=[[0.0]]),
        lambda d: d["robots"][1]["normal_force"].__setitem__(0, -1.0),
        lambda d: d["phases"][0].update(name="lunch"),
        lambda d: d["machine"]["limits"].update(stop_time=0.0),
        lambda d: d["box"]["pose"][3].pop(),
        lambda d: d["time"].__setitem__(0, "0"),
    ]
    for each in broken:
        damaged = json.loads(text_of("json", "job.json"))
        each(damaged)
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(damaged, schema, jsonschema.Draft202012Validator)


@pytest.mark.parametrize("step", [0.0, -1.0, math.nan, math.inf, 2.0])
def test_time_steps_are_checked(step: float) -> None:
    with pytest.raises(SettingsError, match="time step"):
        sample_job(rack_job(), step)
