"""What would let both arms hold the box, against reach alone."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import hybrid_opt as ho
from hybrid_opt.errors import NoHoldError
from hybrid_opt.extras.proposing import remedies
from hybrid_opt.extras.proposing.problem import Problem, read_problem
from hybrid_opt.extras.proposing.proposal import SPINS
from hybrid_opt.extras.proposing.remedies import AMOUNTS, PROBLEM_CHANGES, remedies_text
from hybrid_opt.extras.proposing.setup import reach_missing
from tests.hybrid_opt.extras.proposing.test_proposal import rack_problem

TURNS = 2.0 * np.pi * np.arange(SPINS) / SPINS


def lacking(problem: Problem) -> str:
    return reach_missing(problem.workcell(), problem.poses, TURNS)


def test_the_least_changes_that_help_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A goal some centimetres out of reach: with what is named, both arms reach it."""
    monkeypatch.setattr(remedies, "ENOUGH_CHANGES", 2)
    path = rack_problem(tmp_path, {"task": {"goal": [0.0, 0.0, 1.65, 0.0, 0.0, 0.0]}})
    problem = read_problem(path)
    assert lacking(problem)
    with pytest.raises(NoHoldError) as caught:
        ho.propose(path, rng=np.random.default_rng(1))
    told = str(caught.value).split("both arms could hold it with ")[1].split(", or ")
    assert 1 <= len(told) <= 2
    by_text = {re.sub(r"\{.*?\}", "", kind.text): kind for kind in PROBLEM_CHANGES}
    for text in told:
        amount = float(re.findall(r"\d\.\d\d", text)[0])
        kind = by_text[re.sub(r"\d\.\d\d", "", text)]
        assert amount in AMOUNTS
        assert not lacking(kind.applied(problem, amount))


def test_changes_keep_the_problem_and_move_what_they_say(tmp_path: Path) -> None:
    problem = read_problem(rack_problem(tmp_path))
    before = problem.workcell()
    for kind in PROBLEM_CHANGES:
        after = kind.applied(problem, 0.1).workcell()
        moves = [
            np.linalg.norm(b.T_world_base[:3, 3] - a.T_world_base[:3, 3])
            + np.linalg.norm(b.T_flange_pad[:3, 3] - a.T_flange_pad[:3, 3])
            for a, b in zip(before.robots, after.robots, strict=True)
        ]
        rise = after.task.waypoints[-1].lower[2] - before.task.waypoints[-1].lower[2]
        if kind.text.startswith("goal"):
            assert moves == [0.0, 0.0]
            assert abs(rise) == pytest.approx(0.1)
        else:
            assert moves == pytest.approx([0.1, 0.1], abs=2e-4)
            assert rise == 0.0
    assert problem.workcell().robots[0].T_world_base.tolist() == (
        before.robots[0].T_world_base.tolist()
    )


def test_nothing_is_said_without_time_or_bases(tmp_path: Path) -> None:
    problem = read_problem(rack_problem(tmp_path))
    rng = np.random.default_rng(1)
    assert remedies_text(problem, TURNS, rng, lambda: True) == ""
    data = {**problem.data, "robots": [{"name": "a"}, {"name": "b"}]}
    assert remedies_text(Problem(problem.source, "", data), TURNS, rng, lambda: False) == ""
