"""Places that are proposed for hands that hold by themselves."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import hybrid_opt as ho
from hybrid_opt.extras.proposing.hand_positions import contact_entry
from hybrid_opt.extras.proposing.kinematics import covers_the_same, rotate_about_normal
from hybrid_opt.extras.proposing.problem import Problem, read_problem
from hybrid_opt.robust.budget import required_at_rest
from symbolic.errors import WorkcellError
from symbolic.geometry.pairs import build_geometry
from symbolic.read.cell import load
from symbolic.records import Workcell
from tests.refusals import refused

CUPS = Path("studies/problems/cups-ur10.toml")
PLATE = Path("studies/workcells/plate.toml")


def plate_problem(folder: Path) -> Problem:
    """Return the plate's cell without the places of its fingers."""
    robots = str(PLATE.parents[1].resolve() / "robots")
    places = ("further", "xyz = [0.0, 0.225", "xyz = [0.0, -0.225")
    lines = PLATE.read_text(encoding="utf-8").replace("../robots", robots).splitlines()
    kept = [line for line in lines if not line.startswith(places)]
    file = folder / "plate.toml"
    file.write_text("\n".join(kept), encoding="utf-8")
    return read_problem(file)


def all_places(problem: Problem) -> list[Workcell]:
    places = [problem.contacts, *problem.other_contacts()]
    return [problem.workcell({"contacts": contacts}) for contacts in places]


def test_hands_hold_first_where_they_need_the_least_force_of_all_places() -> None:
    """The reader refuses patches beyond their faces, `build_geometry` tools in the payload; the
    first force is the one that `ho.grip_budget` states."""
    cells = all_places(read_problem(CUPS))
    needed = [float(required_at_rest(cell).max()) / 140.0 for cell in cells]
    assert needed == sorted(needed, key=lambda share: round(share, 3))
    assert needed[0] < 0.6 * needed[-1]
    assert ho.grip_budget(cells[0]).required.max() == pytest.approx(140.0 * needed[0])
    build_geometry(cells[0])
    for cell in cells:
        normals = np.array([pad.T_box_pad[:3, 2] for pad in cell.pads])
        assert normals[:, 2].max() < 0.5, "nothing holds the box from below"
    assert any(np.ptp([pad.T_box_pad[2, 3] for pad in cell.pads]) == 0.0 for cell in cells)


def test_fingers_hold_edges_with_their_tools_outside(tmp_path: Path) -> None:
    """Their places are those of the plate's cell, and three mirrored ones."""
    cells, written = all_places(plate_problem(tmp_path)), load(PLATE)
    build_geometry(cells[-1])
    for cell in cells:
        for contact in cell.contacts:
            (opposite,) = contact.further
            normals = opposite.T_box_pad[:3, 2], -contact.T_box_pad[:3, 2]
            np.testing.assert_allclose(*normals, atol=1e-12)
    assert any(
        all(covers_the_same(a, b) for a, b in zip(cell.contacts, written.contacts, strict=True))
        for cell in cells
    )


@pytest.mark.parametrize("name", ["palletising", "plate", "fork", "transfer"])
def test_a_place_is_read_as_it_was_written(name: str) -> None:
    """Turned by half, each hand stands where another one stood, or keeps its place."""
    for contact in load(f"studies/workcells/{name}.toml").contacts:
        turned = rotate_about_normal(contact, np.pi)
        assert covers_the_same(contact, turned)
        entry = contact_entry(turned)
        assert len(entry.get("further", [])) == len(contact.further)
        np.testing.assert_allclose(entry["xyz"], turned.T_box_pad[:3, 3], atol=1e-9)


@pytest.mark.slow
def test_places_come_before_bases() -> None:
    """Without bases no arm is nearer to a side; each place is a problem of its own then."""
    given = read_problem(CUPS)
    robots = [{k: v for k, v in r.items() if k != "base"} for r in given.data["robots"]]
    problem = replace(given, data={**given.data, "robots": robots})
    sides = problem.sides()
    assert len(sides) == 3
    for side in sides:
        assert all("xyz" in contact for contact in side.data["contacts"])
        entries = side.data["contacts"]
        # What a choice of bases passes on is the whole place.
        assert side.contacts == [{k: e[k] for k in ("xyz", "spin", "further")} for e in entries]


def test_hands_without_room_are_refused() -> None:
    problem = read_problem(CUPS)
    wide = [entry | {"patch_radius": 0.3} for entry in problem.data["contacts"]]
    with refused(WorkcellError, "workcell", "contacts"):
        _ = replace(problem, data={**problem.data, "contacts": wide}).contacts


@pytest.mark.slow
def test_a_carry_with_cups_is_proposed_and_read_again(tmp_path: Path) -> None:
    proposal = ho.propose(CUPS, rng=np.random.default_rng(1))
    file = tmp_path / "cell.toml"
    file.write_text(proposal.text(tmp_path), encoding="utf-8")
    cell = load(file)
    assert ho.grip_budget(cell).fits
    assert all(contact.further for contact in cell.contacts)
    assert proposal.judgement.feasible
