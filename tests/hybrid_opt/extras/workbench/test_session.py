"""A cell that is changed by hand: handles, verdicts, a better carry, what is saved; of what a page
asks for in a row the last counts."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import hybrid_opt as ho
from hybrid_opt.errors import ResultsError
from hybrid_opt.extras.workbench import Session, Workbench, handles, moved
from tests.hybrid_opt.cells import shipped
from tests.refusals import refused
from tests.waiting import until

PALLET = "environment.pallet in front"


@pytest.fixture
def session() -> Session:
    return Session(shipped("rack"))


@pytest.mark.parametrize("name", ["rack", "drum"])
def test_every_handle_is_where_it_is_put(name: str) -> None:
    """And the cell's file says so: each is read anew from the changed one."""
    workcell = shipped(name).workcell
    cell = shipped(name)
    for handle in handles(workcell):
        shift = np.eye(4)
        shift[:3, 3] = 0.0, 0.0, 0.004
        if not handle.turns:  # along its face
            shift[:3, 3] = 0.004 * handle.pose[:3, 0]
        changes = moved(workcell, handle, shift @ handle.pose)
        (there,) = [one for one in handles(cell.changed(changes).workcell) if one.key == handle.key]
        np.testing.assert_allclose(there.pose, shift @ handle.pose, atol=2e-6)


def test_a_change_is_judged_at_once_and_says_what_is_wrong(session: Session) -> None:
    assert session.verdict.feasible
    assert session.verdict.squeeze is not None
    light = session.verdict.squeeze.force
    heavier = session.change({"payload.mass": 11.0})
    assert heavier.feasible
    assert heavier.squeeze is not None
    assert heavier.squeeze.force > light
    blocked = session.change({f"{PALLET}.xyz": [-0.6, 0.0, 0.6]})
    assert not blocked.feasible
    assert "pallet in front" in blocked.text
    assert session.cell.workcell.payload.mass == 11.0


def test_what_is_refused_changes_nothing(session: Session) -> None:
    before = session.verdict
    refused = session.change({"payload.mass": -1.0})
    assert "payload.mass: found -1" in refused.text
    assert session.verdict is before
    assert session.changes == {}
    assert session.change({"contacts.friction": 0.95}).feasible


def test_the_carry_is_made_better_from_where_it_is(session: Session) -> None:
    x = session.x.copy()
    session.change({f"{PALLET}.xyz": [-0.6, 0.0, 0.33]})  # 5 cm higher: the carry meets it
    found = session.optimise(np.random.default_rng(1), evaluations=200)
    assert found.feasible
    assert not np.array_equal(session.x, x)
    assert found.cell is not None
    hand_made = found.cell.evaluate(x)
    best = found.cell.evaluate(session.x)
    assert not hand_made.feasible[0] or best.objectives.prod() < hand_made.objectives.prod()


def test_what_is_saved_is_the_cell_on_the_screen(session: Session, tmp_path: Path) -> None:
    session.change({"payload.mass": 9.0, "force_limit": 100.0})
    assert session.x[-1] == 100.0
    session.optimise(np.random.default_rng(1), evaluations=60)
    path = session.save(tmp_path / "mine")
    again = ho.Cell.load(path)
    assert again.workcell.payload.mass == 9.0
    assert again.workcell.task.time_law == session.base.workcell.task.time_law
    np.testing.assert_allclose(again.drivable().initial[:-1], session.x[:-1], atol=1e-12)
    with refused(ResultsError, "not-empty"):
        session.save(tmp_path / "mine")
    written = session.export("data", tmp_path / "job")
    assert all(file.exists() for file in written)
    carry = ho.load(tmp_path / "job" / "carry.json")
    assert isinstance(carry, ho.Carry)
    np.testing.assert_array_equal(carry.x, session.x)


@pytest.fixture(scope="module")
def bench() -> Iterator[Workbench]:
    page = ho.live(shipped("rack"), port=18080)
    yield page
    page.close()


def test_dragging_never_queues_and_ends_where_it_was_let_go(bench: Workbench) -> None:
    (pallet,) = [one for one in handles(bench.session.cell.workcell) if "pallet" in one.key]
    for k in range(50):
        z = pallet.pose[2, 3] + 0.001 * k
        bench.ask({f"{pallet.key}.xyz": [*pallet.pose[:2, 3].tolist(), z]})
    end = pallet.pose[2, 3] + 0.049

    def there() -> bool:
        body = next(b for b in bench.session.cell.workcell.environment if b.name == pallet.title)
        return bool(abs(body.pose[2, 3] - end) < 1e-9)

    until(there)
    assert np.isfinite(bench.session.verdict.seconds)
