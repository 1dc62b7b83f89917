"""Functions of rows that are compiled when a solve first asks for them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from codegen.cache import Cache
from codegen.compiled import CompiledFunction
from codegen.interpreted import InterpretedFunction
from hybrid_opt.compiled_cell import CompiledCell
from hybrid_opt.polishing import functions
from hybrid_opt.polishing.functions import ORDERS, RowFunctions
from symbolic.smooth.clearance import Clearance
from symbolic.smooth.passage import gap_function
from symbolic.smooth.place import Place
from tests.symbolic.cells import rack_cell


def test_a_row_compiled_on_demand_is_the_interpreted_one_and_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compiled = CompiledCell(rack_cell(), Cache(tmp_path))
    assert compiled.is_identified
    gaps = InterpretedFunction(gap_function(Place(compiled.bodies)))
    plain = RowFunctions(compiled.bodies, {}, gaps)
    row = Clearance(next(k for k in range(99) if k not in plain.separable))
    made = RowFunctions(compiled.bodies, {}, gaps, compiled)
    again = RowFunctions(compiled.bodies, {}, gaps, CompiledCell(rack_cell(), Cache(tmp_path)))
    rng = np.random.default_rng(0)
    for order in ORDERS:
        function, expected = made.of(row, order), plain.of(row, order)
        assert isinstance(function, CompiledFunction)
        assert made.of(row, order) is function
        with monkeypatch.context() as patched:
            patched.setattr(functions, "row_function", not_again)
            assert again.of(row, order).signature == function.signature
        inputs = [rng.uniform(-1.0, 1.0, (5, *shape)) for shape in function.input_shapes]
        found, interpreted = function.batch(*inputs), expected.batch(*inputs)
        for name in function.output_names:
            np.testing.assert_allclose(found[name], interpreted[name], rtol=1e-9, atol=1e-9)


def not_again(*_: Any) -> None:
    raise AssertionError("its expression was built again")
