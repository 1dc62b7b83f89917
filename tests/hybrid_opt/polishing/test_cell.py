"""What programs of a cell share: functions compiled on demand, places of the path."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from codegen.cache import Cache
from codegen.compiled import CompiledFunction
from codegen.interpreted import InterpretedFunction
from hybrid_opt.compiled_cell import CompiledCell
from hybrid_opt.polishing import cell as cell_module
from hybrid_opt.polishing.cell import PLACE_SPACING, Grid, PolishFunctions
from symbolic.smooth.places import ORDERS, Clearance, PlaceSymbols, row_function
from tests.symbolic.cells import hand_cell, rack_cell


def test_a_row_compiled_on_demand_is_the_interpreted_one_and_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compiled = CompiledCell(rack_cell(), Cache(tmp_path))
    made = PolishFunctions(compiled, {})
    pair = next(k for k in range(99) if k not in made.separable)
    row = Clearance(pair, int(compiled.geometry.columns[pair]))
    again = PolishFunctions(CompiledCell(rack_cell(), Cache(tmp_path)), {})
    symbols = PlaceSymbols(compiled.bodies)
    rng = np.random.default_rng(0)
    for order in ORDERS:
        function = made.row(row, order)
        expected = InterpretedFunction(row_function(symbols, row, order))
        assert isinstance(function, CompiledFunction)
        assert made.row(row, order) is function
        with monkeypatch.context() as patched:
            patched.setattr(cell_module, "row_function", not_again)
            assert again.row(row, order).signature == function.signature
        inputs = [rng.uniform(-1.0, 1.0, (5, *shape)) for shape in function.input_shapes]
        found, interpreted = function.batch(*inputs), expected.batch(*inputs)
        for name in function.output_names:
            np.testing.assert_allclose(found[name], interpreted[name], rtol=1e-9, atol=1e-9)


def not_again(*_: Any) -> None:
    raise AssertionError("its expression was built again")


@pytest.mark.parametrize("samples", [20, 50, 100, 200, 400])
def test_widths_do_not_depend_on_the_number_of_samples(samples: int) -> None:
    cell = hand_cell()
    grid = Grid(replace(cell.task, samples=samples))
    spacing = grid.parameter[1]
    assert spacing == pytest.approx(PLACE_SPACING, rel=0.35)
    for width in (0.015, 0.04, 0.08):
        assert grid.places(width) * spacing == pytest.approx(width, abs=spacing)
    np.testing.assert_allclose(grid.parameter[:: grid.per_sample], grid.sample_parameter)
