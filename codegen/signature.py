"""What a numeric function takes and gives: names and NumPy shapes.

CasADi stores matrices by column. A CasADi (r, c) matrix is therefore a NumPy (c, r) array in C
order without a copy; a column or row vector is (n,) and a scalar (1, 1) is ().
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import casadi as ca

Shape = tuple[int, ...]


@dataclass(frozen=True)
class Signature:
    """Name, arguments and results of a numeric function; every array is dense float64.

    Attributes:
        name: of the function.
        input_names, output_names: in call order.
        input_shapes, output_shapes: NumPy shapes of one evaluation.
    """

    name: str
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    input_shapes: tuple[Shape, ...]
    output_shapes: tuple[Shape, ...]

    @classmethod
    def of(cls, function: ca.Function) -> Signature:
        """Signature of a CasADi function, its sparse inputs and outputs taken as dense."""
        return cls(
            name=function.name(),
            input_names=tuple(function.name_in()),
            output_names=tuple(function.name_out()),
            input_shapes=tuple(numpy_shape(*function.size_in(i)) for i in range(function.n_in())),
            output_shapes=tuple(
                numpy_shape(*function.size_out(i)) for i in range(function.n_out())
            ),
        )

    @classmethod
    def from_json(cls, stored: Mapping[str, Any]) -> Signature:
        """Read what `to_json` wrote."""
        return cls(
            name=stored["name"],
            input_names=tuple(stored["input_names"]),
            output_names=tuple(stored["output_names"]),
            input_shapes=tuple(tuple(shape) for shape in stored["input_shapes"]),
            output_shapes=tuple(tuple(shape) for shape in stored["output_shapes"]),
        )

    def to_json(self) -> dict[str, Any]:
        """As plain lists and strings."""
        return {
            "name": self.name,
            "input_names": list(self.input_names),
            "output_names": list(self.output_names),
            "input_shapes": [list(shape) for shape in self.input_shapes],
            "output_shapes": [list(shape) for shape in self.output_shapes],
        }

    def output_record(self) -> np.dtype[np.void]:
        """Structured type that holds all outputs of one evaluation in one block of memory."""
        return np.dtype(
            [
                (name, np.float64, shape)
                for name, shape in zip(self.output_names, self.output_shapes, strict=True)
            ]
        )


def numpy_shape(rows: int, columns: int) -> Shape:
    """NumPy shape of a dense CasADi (rows, columns) matrix."""
    if rows == 1 or columns == 1:
        return () if rows == columns else (rows * columns,)
    return (columns, rows)
