"""What blocks the pads of a proposed carry; the oracle is the job, compiled and certified."""

from __future__ import annotations

from dataclasses import replace

import pytest

from hybrid_opt.errors import JobError
from hybrid_opt.proposing.grasping import grasp_blocked
from hybrid_opt.proposing.trial import Trial
from symbolic.read.cell import load
from symbolic.records import Handling
from tests.hybrid_opt.job.jobs import rack, rack_jobs, rack_timing
from tests.symbolic.read.samples import RACK


@pytest.fixture(scope="module")
def trial() -> Trial:
    begin = rack().carry(rack().initial)
    return Trial(load(RACK), (begin.arms[0].q[0], begin.arms[1].q[0]))


@pytest.mark.parametrize(
    ("handling", "told"),
    [
        ({}, ""),
        ({"lift_height": 0.0, "set_down_height": 0.0}, ""),
        ({"set_down_height": 0.02}, "set down: payload meets liner"),
        ({"lift_height": 0.03}, "lift: payload meets middle board"),
        ({"stand_off": 1.2}, "approach: an arm "),
        ({"lift_height": 0.5}, "lift: payload meets"),
    ],
)
def test_what_blocks_is_what_refuses_the_job(
    handling: dict[str, float], told: str, trial: Trial, monkeypatch: pytest.MonkeyPatch
) -> None:
    chosen = Handling(**handling)
    monkeypatch.setattr(trial, "workcell", replace(trial.workcell, handling=chosen))
    found = grasp_blocked(trial)
    if not told:
        assert found == ""
        rack_jobs().plan(rack_timing(), handling=chosen)
        return
    assert found.startswith(told)
    with pytest.raises(JobError):
        rack_jobs().plan(rack_timing(), handling=chosen)


def test_pads_that_have_no_jobs_are_not_looked_at(
    trial: Trial, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = trial.workcell.contacts[0]
    same = replace(trial.workcell, contacts=(first, first))
    assert not same.has_facing_pads
    monkeypatch.setattr(trial, "workcell", same)
    assert grasp_blocked(trial) == ""
