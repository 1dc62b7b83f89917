"""Proposals of whole cells; the oracle is the cell's own evaluator, compiled, from the file."""

from __future__ import annotations

import itertools
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hybrid_opt as ho
from hybrid_opt.errors import NoHoldError, ProposalError
from hybrid_opt.extras.proposing import proposal as proposal_module
from hybrid_opt.extras.proposing import setup
from hybrid_opt.extras.proposing.problem import Problem
from hybrid_opt.extras.proposing.proposal import RESTARTS, SEARCH_ROUNDS, propose_classes, worked
from symbolic.array import Array
from symbolic.errors import SettingsError, WorkcellError
from symbolic.read.cell import load
from symbolic.read.editing import completed, merged
from symbolic.records import Cylinder, Workcell
from symbolic.records.poses import pose_matrix
from tests.hybrid_opt.extras.proposing.generated import write_problem
from tests.hybrid_opt.extras.proposing.problems import (
    BAXTER,
    shipped_problem,
    tiago_problem,
    turned_problem,
)
from tests.refusals import refused
from tests.torso import Torso

RACK = Path("studies/workcells/rack.toml")


def rack_problem(folder: Path, changes: dict[str, Any] | None = None) -> Path:
    """The rack without its hand-made trajectory, spins and waypoints."""
    text = RACK.read_text(encoding="utf-8")
    data = tomllib.loads(text)
    urdf = str(RACK.resolve().parent / data["robots"][0]["urdf"])
    stripped = {
        "robots": [{"urdf": urdf}, {"urdf": urdf}],
        "contacts": [{"spin": None}, {"spin": None}],
        "task": {"initial": None, "waypoints": None},
    }
    path = folder / "rack.toml"
    stripped = merged(stripped, changes or {})
    path.write_text(completed(text, data, stripped), encoding="utf-8")
    return path


TOLD: list[tuple[int, int]] = []
"""Seconds worked and those that it may work, as `proposal` told them."""


@pytest.fixture(scope="module")
def proposal(tmp_path_factory: pytest.TempPathFactory) -> ho.Proposal:
    path = rack_problem(tmp_path_factory.mktemp("rack"))
    return ho.propose(
        path,
        rng=np.random.default_rng(1),
        progress=lambda done, total: TOLD.append((done, total)),
    )


def test_the_time_that_is_gone_is_told(proposal: ho.Proposal) -> None:
    seconds, limits = zip(*TOLD, strict=True)
    assert set(limits) == {ho.ProposeSettings().seconds}
    assert list(seconds) == sorted(seconds)
    assert 0.0 < seconds[-1] <= np.ceil(proposal.seconds)  # the last is told after it was found


def test_the_rack_gets_a_certified_carry(proposal: ho.Proposal, tmp_path: Path) -> None:
    path = tmp_path / "proposed.toml"
    path.write_text(proposal.text(tmp_path), encoding="utf-8")
    cell = ho.Cell.load(path)
    judged = cell.carry(cell.initial).judgement
    assert judged is not None
    assert judged.feasible
    assert judged.objectives == pytest.approx(proposal.judgement.objectives, abs=1e-6)
    assert cell.certify(cell.initial).is_free
    found = cell.evaluate(cell.random(2000, np.random.default_rng(5)))
    assert 0.02 <= found.feasible.mean() <= 0.20
    assert proposal.feasible_share == pytest.approx(found.feasible.mean(), abs=0.06)
    assert "# Two GoFa 12 carry a box" in path.read_text(encoding="utf-8"), "comments stay"
    assert "certified" in str(proposal)


@pytest.mark.parametrize("repetition", [1, RESTARTS])
def test_the_last_round_is_repeated_until_a_carry_is_found(
    proposal: ho.Proposal, repetition: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rounds: list[int] = []

    def attempts(_: object, lazy: object, effort: int, *__: object) -> Iterator[ho.Proposal]:
        first.append(lazy)
        if lazy is first[0]:
            rounds.append(effort)
            if len(rounds) == len(SEARCH_ROUNDS) + repetition:
                yield proposal

    first: list[object] = []
    monkeypatch.setattr("hybrid_opt.extras.proposing.proposal._Search._round", attempts)
    assert ho.propose(rack_problem(tmp_path), rng=np.random.default_rng(1)) is proposal
    last = SEARCH_ROUNDS[-1][0]
    assert rounds == [effort for effort, *_ in SEARCH_ROUNDS] + [last] * repetition


def test_what_a_carry_passes_is_told(proposal: ho.Proposal) -> None:
    """A carry that passes nothing need not be straight: the box may leave what it stands on."""
    assert "top board" in proposal.passes
    assert proposal.passes in str(proposal)
    nothing = replace(proposal, sides=())
    assert nothing.passes == "nothing"
    assert "nothing" not in str(nothing)
    assert "the lamp" in str(replace(proposal, blocked="the lamp"))


@pytest.mark.parametrize(
    ("changes", "end"),
    [
        ({"task": {"goal": [0.0, 0.0, 1.65, 0.0, 0.0, 0.0]}}, "goal"),
        ({"task": {"start": [0.35, 0.0, 0.745, 0.0, 0.0, 1.5]}}, "start"),
        (
            {
                "payload": {"size": [0.3, 4.0, 0.25]},
                "contacts": [{"xyz": [0.0, 2.0, 0.0]}, {"xyz": [0.0, -2.0, 0.0]}],
            },
            "",
        ),
    ],
)
def test_what_is_out_of_reach_or_too_wide_is_told_before_any_work(
    changes: dict[str, Any], end: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither collision bounds nor ways to hold are made first."""

    def work(*given: object) -> None:
        pytest.fail("work before reach was looked at")

    monkeypatch.setattr(setup, "judge_of", work)
    monkeypatch.setattr(setup, "find_holds", work)
    path = rack_problem(tmp_path, changes)
    begun = worked()
    told = rf"(left|right) lacks 0\.\d+ m to its contact at the {end}"
    settings = ho.ProposeSettings(remedies=False)
    with pytest.raises(NoHoldError, match=told):
        ho.propose(path, rng=np.random.default_rng(1), settings=settings)
    assert worked() - begun < 5.0  # measured: 0.4


def test_every_pair_of_faces_is_tried_both_ways_round(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those that face the robots first, top and bottom last."""
    tried: list[Array] = []

    def refuse(problem: Problem, given: dict[str, Any], *rest: object) -> None:
        contacts = given.get("contacts", problem.contacts)
        tried.append(np.array([contact["xyz"] for contact in contacts]))
        raise ProposalError("cannot be held")

    monkeypatch.setattr(proposal_module, "prepare", refuse)
    path = rack_problem(tmp_path)
    text = path.read_text(encoding="utf-8")
    for point in ("0.0, 0.20, 0.055", "0.0, -0.20, 0.055"):
        assert text.count(f"xyz = [{point}]\n") == 1
        text = text.replace(f"xyz = [{point}]\n", "")
    path.write_text(text, encoding="utf-8")
    settings = ho.ProposeSettings(remedies=False)
    with refused(NoHoldError, "no-hold"):
        ho.propose(path, rng=np.random.default_rng(1), settings=settings)
    assert len({pair.tobytes() for pair in tried}) == len(tried) == 6
    size = load(RACK).payload.size
    for pair in tried:
        np.testing.assert_array_equal(pair[0], -pair[1])
        assert np.abs(pair[0]).max() == pytest.approx(size[np.argmax(np.abs(pair[0]))] / 2.0)
    axes = [int(np.argmax(np.abs(pair[0]))) for pair in tried]
    assert axes[0] == 1
    assert axes[-2:] == [2, 2]
    assert tried[0][0][1] > 0.0, "the left robot stands at +y"


def test_a_failure_for_lack_of_time_says_so_and_names_a_time_to_try(tmp_path: Path) -> None:
    """A clock that goes on by ten seconds with every look."""
    looks = itertools.count()
    settings = ho.ProposeSettings(seconds=10.0, clock=lambda: 10.0 * next(looks))
    with refused(ProposalError, "out-of-time", "--time 25"):
        ho.propose(rack_problem(tmp_path), rng=np.random.default_rng(1), settings=settings)


def test_time_is_what_was_worked_and_not_what_went_by() -> None:
    clock = ho.ProposeSettings().clock
    begun, wall = clock(), time.monotonic()
    time.sleep(0.5)
    assert time.monotonic() - wall >= 0.5
    assert clock() - begun < 0.2
    begun = clock()
    subprocess.run([sys.executable, "-c", "sum(range(20_000_000))"], check=True)
    assert clock() - begun > 0.1, "children count"


def test_what_the_start_collides_with_is_named(tmp_path: Path) -> None:
    path = rack_problem(tmp_path, {"task": {"start": [0.0, 0.0, 0.72, 0.0, 0.0, 0.0]}})
    with refused(ProposalError, "no-hold", "payload", "middle board"):
        ho.propose(path, rng=np.random.default_rng(1))


def test_a_wrong_problem_is_told_before_any_work(tmp_path: Path) -> None:
    path = rack_problem(tmp_path, {"task": {"reference_speed": -1.0}})
    with pytest.raises(WorkcellError, match=r"task\.reference_speed"):
        ho.propose(path, rng=np.random.default_rng(1))


@pytest.mark.slow
def test_pads_stand_off_less_where_something_is_behind_a_wrist(tmp_path: Path) -> None:
    """A peg 35 mm behind the left wrist at the start."""
    path = rack_problem(tmp_path)
    peg = "\n[[environment]]\nname = 'peg'\nkind = 'box'\nsize = [0.02, 0.02, 0.02]\n"
    text = path.read_text(encoding="utf-8") + peg + "xyz = [0.0, 0.663, 0.8]\n"
    path.write_text(text, encoding="utf-8")
    found = ho.propose(path, rng=np.random.default_rng(1))
    assert not found.blocked
    assert "stand-off 30 mm" in str(found)
    path.write_text(found.text(tmp_path), encoding="utf-8")
    assert load(path).handling.stand_off == 0.03


@pytest.mark.slow
def test_generated_cells_get_carries(tmp_path: Path) -> None:
    """Of twenty at least sixteen, each within a minute of one core."""
    settings = ho.ProposeSettings(seconds=60.0)
    solved = 0
    for seed in range(20):
        path = write_problem(seed, tmp_path)
        try:
            found = ho.propose(path, rng=np.random.default_rng(1), settings=settings)
        except ProposalError:
            continue
        assert found.judgement.feasible
        assert 0.02 <= found.feasible_share <= 0.20
        solved += found.seconds <= 60.0
    assert solved >= 16


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["tiago", "baxter", "torso", "pandas", "drum", "fork", "turned", "pitched"]
)
@pytest.mark.filterwarnings("ignore::symbolic.geometry.hulls.CollisionModelWarning")
def test_cells_of_every_kind_get_carries(name: str, tmp_path: Path) -> None:
    """Machines with both arms in one file, portals, other payloads and pads, a box turned over."""
    path = tmp_path / "problem.toml"
    if name == "tiago":
        path = tiago_problem(tmp_path)
    elif name == "torso":  # of six joints, as RB-Y1's
        axes = ("1 0 0", "0 1 0", "0 1 0", "0 1 0", "1 0 0", "0 0 1")
        path = Torso(axes).problem(tmp_path)
    elif name == "baxter":
        path.write_text(BAXTER, encoding="utf-8")
    elif name in ("turned", "pitched"):
        rotation = "quaternion" if name == "turned" else "roll-pitch-yaw"
        path = turned_problem(tmp_path, rotation)
    else:
        path = shipped_problem(name, tmp_path)
    settings = ho.ProposeSettings()
    found = ho.propose(path, rng=np.random.default_rng(1), settings=settings)
    assert found.judgement.feasible
    assert 0.02 <= found.feasible_share <= 0.20
    assert found.seconds <= settings.seconds
    proposed = tmp_path / "proposed.toml"
    proposed.write_text(found.text(tmp_path), encoding="utf-8")
    contacts = load(proposed).contacts
    if name == "fork":  # its pads stand rigidly beside one another; a half turn swaps them
        stand, wanted = (
            sorted([*pad.T_box_pad[:3, 3], *pad.T_box_pad[:3, 2]] for pad in (one, *one.further))
            for one in (contacts[0], load(path).contacts[0])
        )
        np.testing.assert_allclose(stand, wanted, atol=1e-8)


def gaps_to_the_post(workcell: Workcell, pose: Array) -> dict[str, float]:
    """How far the corners of the box at a pose (6,) are beyond the upright post at x = y = 0, on
    each side [m]; negative where they reach into its height or its width."""
    post = next(body for body in workcell.environment if body.name == "post")
    assert isinstance(post.shape, Cylinder)
    corners = np.array(list(itertools.product((-0.5, 0.5), repeat=3))) * workcell.payload.size
    T_world_box = pose_matrix(pose[:3], pose[3:])
    _, y, z = T_world_box[:3, :3] @ corners.T + T_world_box[:3, 3:]
    return {
        "over": z.min() - (post.pose[2, 3] + post.shape.length / 2.0),
        "left of": y.min() - post.shape.radius,
        "right of": -y.max() - post.shape.radius,
    }


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::symbolic.geometry.hulls.CollisionModelWarning")
def test_carries_of_other_classes_are_found_beside_the_first(tmp_path: Path) -> None:
    """Past the post on three sides, each as its own file says; the shortest first."""
    settings = ho.ProposeSettings(seconds=300.0, classes=3)
    problem = Path("studies/problems/past-a-post.toml")
    found = propose_classes(problem, rng=np.random.default_rng(1), settings=settings)
    assert [one.length for one in found] == sorted(one.length for one in found)
    for number, one in enumerate(found):
        path = tmp_path / f"{number}.toml"
        path.write_text(one.text(tmp_path), encoding="utf-8")
        cell = ho.Cell.load(path)
        assert cell.certify(cell.initial).is_free
        pose = cell.carry(cell.initial).pose
        at = pose[np.argmin(np.abs(pose[:, 0]))]
        gaps = gaps_to_the_post(cell.workcell, at)
        told = one.sides[0].removesuffix(" post")
        assert told == max(gaps, key=lambda side: gaps[side])
        assert gaps[told] > 0.0
    assert len({(one.sides, one.found.branches) for one in found}) == 3
    assert len({one.sides for one in found}) >= 2


@pytest.mark.parametrize(
    "wrong", [{"classes": 0}, {"seconds": 0.0}, {"feasible": (0.3, 0.2)}], ids=str
)
def test_settings_are_checked(wrong: dict[str, Any]) -> None:
    with pytest.raises(SettingsError, match=next(iter(wrong))):
        ho.ProposeSettings(**wrong)
