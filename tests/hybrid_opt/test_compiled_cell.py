"""What is compiled of a cell: once for all, kept where numbers change, all before a study."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
import pytest

import hybrid_opt as ho
import symbolic.cell_model
from codegen.build import build
from codegen.compiler import Compiler
from codegen.errors import CodegenError
from codegen.function import NumericFunction
from codegen.interpreted import InterpretedFunction
from hybrid_opt import compiled_cell
from hybrid_opt.campaign.stages import build_study
from hybrid_opt.carry import at_rest
from hybrid_opt.cell import Cell
from hybrid_opt.compiled_cell import CompiledCell
from hybrid_opt.evaluate import kernel
from hybrid_opt.job.plan import JobCollisions
from hybrid_opt.polishing.polisher import make_polisher
from hybrid_opt.polishing.settings import PolishSettings
from hybrid_opt.progress import Progress
from hybrid_opt.robust.force import RobustModel, robust_model
from hybrid_opt.timing.candidates import search_carry
from hybrid_opt.timing.model import TimingModel
from symbolic.cell_model import CellModel
from symbolic.parameters import START
from tests.refusals import refused
from tests.symbolic.cells import RACK, hand_cell, hand_model, rack_cell


@pytest.mark.usefixtures("cache")
def test_the_model_is_built_once_for_all_functions(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if nothing had been compiled before; only the compiler is left out."""
    models: list[CellModel] = []
    build_cell_model = symbolic.cell_model.build_cell_model

    def counted(*of: Any) -> CellModel:
        models.append(build_cell_model(*of))
        return models[-1]

    def built(
        key: str, make: Callable[[], Mapping[str, ca.Function]], *_: Any, **__: Any
    ) -> dict[str, NumericFunction]:
        return {name: InterpretedFunction(function) for name, function in make().items()}

    def no_program(name: str, key: str, make: Callable[[], Any], *_: Any) -> SimpleNamespace:
        make()
        return SimpleNamespace(dual_arm_lanes=lambda: 1)

    monkeypatch.setattr(symbolic.cell_model, "build_cell_model", counted)
    monkeypatch.setattr(compiled_cell, "load_or_build", built)
    monkeypatch.setattr(kernel, "load_or_build_program", no_program)
    cell = Cell(rack_cell())
    assert not models
    assert cell.evaluator.functions is cell.compiled.evaluators
    assert search_carry(cell.timing_model, cell.initial).workcell is cell.workcell
    assert cell.polish_functions.model is cell.compiled.bodies
    assert len(models) <= 1


def test_a_missing_compiler_is_told_before_any_work(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("CC", "/missing/cc")
    with refused(CodegenError, "no-compiler"):
        CompiledCell(hand_cell())


def test_keys_tell_sets_and_structures_apart() -> None:
    cell = rack_cell()
    keys = [
        CompiledCell(cell).key("set"),
        CompiledCell(cell).key("other"),
        CompiledCell(cell).key("set", "200"),
        CompiledCell(cell).key("set", bodies=False),
        CompiledCell(replace(cell, task=replace(cell.task, samples=11))).key("set"),
    ]
    assert len(set(keys)) == len(keys)


def test_a_given_model_has_its_own_start_postures() -> None:
    model = hand_model(hand_cell())
    given = CompiledCell(hand_cell(), model=model)
    assert given.model is model
    assert given.bodies is model
    assert given.vector(START).tolist() == np.concatenate(model.start).tolist()


def test_bodies_are_known_without_start_postures(monkeypatch: pytest.MonkeyPatch) -> None:
    def unwanted(*_: Any) -> None:
        raise AssertionError("start postures are not asked for")

    compiled = CompiledCell(rack_cell())
    with monkeypatch.context() as patched:
        patched.setattr(symbolic.cell_model, "start_branches", unwanted)
        bodies = compiled.bodies
        with pytest.raises(AssertionError):
            _ = compiled.model
    assert compiled.model.geometry is bodies.geometry
    joints = [len(start) for start in compiled.model.start]
    assert [arm.joints for arm in bodies.geometry.arms] == joints


def test_start_postures_are_those_of_the_interpreted_search() -> None:
    compiled = CompiledCell(rack_cell())
    expected = symbolic.cell_model.build_cell_model(compiled.workcell, compiled.bodies)
    for found, branches, interpreted in zip(
        compiled.start, compiled.model.branches, expected.branches, strict=True
    ):
        assert [b.kept for b in branches] == [b.kept for b in interpreted]
        np.testing.assert_allclose(found, interpreted[0].q, atol=1e-9)


CHANGE = {"payload.mass": 8.0, "robots.left.base.xyz": [-0.15, 1.18, 0.2]}

PROGRAM = f"""
import sys
sys.modules["ziglang"] = None  # not installed
import hybrid_opt as ho

cell = ho.Cell.load({str(RACK)!r})
new = cell.changed({CHANGE})
print(new.carry(new.initial).normal_force.max(), new.evaluate(new.initial).feasible.all())
"""


@pytest.mark.process
def test_a_machine_without_a_compiler_takes_changed_numbers(tmp_path: Path) -> None:
    ho.Cell.load(RACK).evaluate(ho.Cell.load(RACK).initial)  # what the structure needs is built
    # The compiler that was used last is the one whose libraries are looked for.
    x = ca.SX.sym("x")
    build({"anew": ca.Function("anew", [x], [2.0 * x])}, rebuild=True)
    without = {name: value for name, value in os.environ.items() if name != "CC"} | {"PATH": ""}
    command = [sys.executable, "-c", PROGRAM]
    done = subprocess.run(command, env=without, capture_output=True, text=True, check=True)
    cell = ho.Cell.load(RACK).changed(CHANGE)
    feasible = cell.evaluate(cell.initial).feasible.all()
    assert done.stdout == f"{cell.carry(cell.initial).normal_force.max()} {feasible}\n"
    empty = without | {"DUAL_ARM_CACHE": str(tmp_path / "empty")}
    done = subprocess.run(command, env=empty, capture_output=True, text=True, check=False)
    assert done.returncode != 0
    last = done.stderr.splitlines()[-1]
    assert last.startswith("codegen.errors.CodegenError: ")
    assert "apt install" in last


@pytest.mark.slow
def test_nothing_is_compiled_after_everything_was_built(monkeypatch: pytest.MonkeyPatch) -> None:
    build_study(Cell.load(RACK), Progress(shown=False))

    def refuse(self: Compiler, *given: object, **more: object) -> None:
        raise AssertionError(f"compiles {given[0]}")

    monkeypatch.setattr(Compiler, "compile", refuse)
    cell = Cell.load(RACK)
    for each in (cell, cell.drivable()):
        assert make_polisher(each.evaluator, PolishSettings()) is not None
        assert TimingModel(each.compiled).joint_names
        assert JobCollisions(each.compiled).geometry.active
        assert RobustModel(each.workcell).workcell is each.workcell
    assert robust_model(cell.drivable().workcell).nominal(at_rest()).min() > 0.0
    build_study(Cell.load(RACK), Progress(shown=False))
