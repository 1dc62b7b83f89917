"""What a study compiles is there before it begins: afterwards no compiler is needed."""

from __future__ import annotations

from pathlib import Path

import pytest

from codegen.compiler import Compiler
from hybrid_opt.building import build_study
from hybrid_opt.cell import Cell
from hybrid_opt.job.plan import JobCollisions
from hybrid_opt.polishing.polisher import Polisher
from hybrid_opt.polishing.settings import PolishSettings
from hybrid_opt.progress import Progress
from hybrid_opt.robust.cases import CaseForces
from hybrid_opt.robust.force import at_rest, pressing_model
from hybrid_opt.timing.model import TimingModel

RACK = Path("studies/workcells/rack.toml")


@pytest.mark.slow
def test_nothing_is_compiled_after_everything_was_built(monkeypatch: pytest.MonkeyPatch) -> None:
    build_study(Cell.load(RACK), Progress(shown=False))

    def refuse(self: Compiler, *given: object, **more: object) -> None:
        raise AssertionError(f"compiles {given[0]}")

    monkeypatch.setattr(Compiler, "compile", refuse)
    cell = Cell.load(RACK)
    for each in (cell, cell.drivable()):
        assert Polisher(each.evaluator, PolishSettings()) is not None
        assert TimingModel(each.compiled).joint_names
        assert JobCollisions(each.compiled).geometry.active
        assert CaseForces(each.workcell).workcell is each.workcell
    assert pressing_model(cell.drivable().workcell).nominal(at_rest()).min() > 0.0
    build_study(Cell.load(RACK), Progress(shown=False))
