"""Ways to a job's first position: judged densely by FCL, with every pair of arm and box."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pinocchio as pin
import pytest

import hybrid_opt as ho
from hybrid_opt.errors import JobError
from hybrid_opt.job.plan import job_geometry
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.geometry.pairs import coal_distance
from symbolic.robot.branches import inverse_kinematics
from tests.hybrid_opt.job.jobs import rack, rack_job
from tests.symbolic.geometry.collision_cells import placed_pieces


def other_branch(q: Array) -> Array:
    """Another posture of the first arm with its flange where it is, both arms side by side."""
    robot, model = rack().workcell.robots[0], rack().compiled.model.robots[0]
    data = model.model.createData()
    pin.framesForwardKinematics(model.model, data, q[:6])
    flange = data.oMf[model.flange_id].homogeneous
    found = inverse_kinematics(robot, model, flange)
    return np.concatenate([found[np.argmin(np.abs(found[:, 1] - 0.3))], q[6:]])


@pytest.mark.parametrize("after", [False, True])
def test_an_arm_changes_its_branch_before_it_grips_and_drives_home(after: bool) -> None:
    job = rack_job()
    end = job.phases[-1].motion.q[-1] if after else job.phases[0].motion.q[0]
    pose = job.phases[-1].motion.pose[-1] if after else job.phases[0].motion.pose[0]
    home = np.array([0.0, 0.0, 0.0, 0.0, 1.57, 0.0] * 2) if after else other_branch(end)
    way = ho.plan_reach(job, home, rng=np.random.default_rng(1), after=after)
    ends = (end, home) if after else (home, end)
    np.testing.assert_array_equal(way[[0, -1]], ends)
    geometry = job_geometry(job.workcell, everywhere=True)
    assert len(geometry.active) > len(job_geometry(job.workcell).active), "pads against the box"
    for first, last in pairwise(way):
        for q in np.linspace(first, last, 12):
            pieces = placed_pieces(geometry, pose, q[:6], q[6:])
            for pair in geometry.active:
                names = {geometry.bodies[k].group for k in (pair.first, pair.second)}
                if names != {"payload", "environment"}:  # the box stands
                    assert coal_distance(pieces[pair.first], pieces[pair.second]) > 0.0


def test_what_cannot_be_is_told() -> None:
    job, rng = rack_job(), np.random.default_rng(1)
    with pytest.raises(SettingsError, match="needs 12 joint positions"):
        ho.plan_reach(job, np.zeros(6), rng=rng)
    held = job.phase("carry").motion.q[0].copy()
    held[1] += 0.5
    with pytest.raises(JobError, match="meets"):
        ho.plan_reach(job, held, rng=rng)
