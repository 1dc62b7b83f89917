"""The compiled functions of a polish."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from codegen.cache import Cache
from codegen.interpreted import InterpretedFunction
from codegen.native import TapeFunction
from hybrid_opt.compiled_cell import CompiledCell
from hybrid_opt.polishing import functions
from hybrid_opt.polishing.functions import PolishFunctions
from symbolic.smooth.path_points import ORDERS, Clearance, PathPointSymbols, row_function
from tests.symbolic.cells import rack_cell


def test_a_row_made_on_demand_is_the_interpreted_one_and_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compiled = CompiledCell(rack_cell(), Cache(tmp_path))
    made = PolishFunctions(compiled, {})
    pair = next(k for k in range(99) if k not in made.separable)
    row = Clearance(pair, int(compiled.geometry.columns[pair]))
    again = PolishFunctions(CompiledCell(rack_cell(), Cache(tmp_path)), {})
    symbols = PathPointSymbols(compiled.bodies)
    rng = np.random.default_rng(0)
    for order in ORDERS:
        function = made.row(row, order)
        expected = InterpretedFunction(row_function(symbols, row, order))
        assert isinstance(function, TapeFunction)
        assert made.row(row, order) is function
        with monkeypatch.context() as patched:
            patched.setattr(functions, "row_function", not_again)
            assert again.row(row, order).signature == function.signature
        inputs = [rng.uniform(-1.0, 1.0, (5, *shape)) for shape in function.input_shapes]
        found, interpreted = function.batch(*inputs), expected.batch(*inputs)
        for name in function.output_names:
            np.testing.assert_allclose(found[name], interpreted[name], rtol=1e-9, atol=1e-9)


def not_again(*_: Any) -> None:
    raise AssertionError("its expression was built again")
