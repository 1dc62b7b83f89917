"""Evaluation of CasADi functions without compilation, as a reference for compiled functions.

The interpreter also replaces compilation if a function is evaluated so few times that compiling it
would take longer. A scalar function (type SX) then runs from its tape (`codegen.native`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from codegen.build import compile_function
from codegen.cache import Cache
from codegen.errors import CodegenError
from codegen.function import NumericFunction, Signature
from codegen.native import Tape, TapeFunction, thread_pool
from codegen.source import dense
from symbolic.array import Array

AGREEMENT_TOLERANCE = 1e-10
"""Largest relative difference allowed between compiled and interpreted."""

RESIDUE = 1e-6
"""Outputs whose largest entry is below this (m, rad, N, s) are residues of rounding and are
compared to this instead of to their own size."""


class InterpretedFunction(NumericFunction):
    """A CasADi function evaluated by CasADi's interpreter.

    Attributes:
        function: the CasADi function with dense inputs and outputs.
    """

    def __init__(self, function: ca.Function) -> None:
        """Store a CasADi function, with sparse inputs and outputs made dense."""
        super().__init__(Signature.of(function))
        self.function = dense(function)

    def _evaluate_block(self, inputs: Sequence[Array], block: NDArray[np.void]) -> None:
        self._evaluator(inputs, [block[name] for name in self.output_names])()

    def _evaluate_batch(
        self,
        inputs: Sequence[Array],
        batched: Sequence[bool],
        outputs: Sequence[Array],
        n: int,
        threads: int,
    ) -> None:
        pieces = min(n, threads)
        bounds = [n * piece // pieces for piece in range(pieces + 1)]

        def evaluate(part: tuple[int, int]) -> None:
            self._evaluate_range(inputs, batched, outputs, *part)

        if pieces == 1:
            evaluate((0, n))
        else:
            # CasADi's interpreter lets other threads run meanwhile.
            list(thread_pool().map(evaluate, pairwise(bounds)))

    def _evaluate_range(
        self,
        inputs: Sequence[Array],
        batched: Sequence[bool],
        outputs: Sequence[Array],
        begin: int,
        end: int,
    ) -> None:
        """Evaluate a range of a batch, one evaluation after another.

        Args:
            inputs, batched, outputs: as for `NumericFunction._evaluate_batch`.
            begin, end: numbers of the first evaluation and of the one after the last.
        """
        # One evaluation's memory serves all: CasADi gets addresses once a range.
        own = [
            np.empty(array.shape[1:]) if per else array
            for array, per in zip(inputs, batched, strict=True)
        ]
        found = [np.empty(array.shape[1:]) for array in outputs]
        changing = [
            (array, one) for array, one, per in zip(inputs, own, batched, strict=True) if per
        ]
        evaluate = self._evaluator(own, found)
        for k in range(begin, end):
            for array, one in changing:
                one[...] = array[k]
            evaluate()
            for array, one in zip(outputs, found, strict=True):
                array[k] = one

    def _evaluator(self, inputs: Sequence[Array], outputs: Sequence[Array]) -> Callable[[], None]:
        """Return a function without arguments that evaluates from the arrays `inputs` into
        `outputs`."""
        buffer, evaluate = self.function.buffer()
        for i, array in enumerate(inputs):
            buffer.set_arg(i, array.data)
        for i, array in enumerate(outputs):
            buffer.set_res(i, array.data)

        def checked() -> None:
            evaluate()
            if buffer.ret():
                raise CodegenError(f"{self.name}: the function failed")

        return checked


def interpret(function: ca.Function) -> NumericFunction:
    """Return a numeric function without compiling.

    A small C++ module runs the function's instructions (`Tape.of`) if it knows them all, else
    CasADi's interpreter does.
    """
    tape = Tape.of(function)
    return InterpretedFunction(function) if tape is None else TapeFunction(tape)


@dataclass(frozen=True)
class Agreement:
    """Largest relative differences between a compiled function and CasADi's interpreter.

    Attributes:
        name: name of the function.
        samples: number of random inputs.
        outputs: largest difference of any output entry.
        derivatives: largest difference of any entry of the derivative along a random direction of
            all inputs.
        worst_output: name of the output, or of the derivative, with the largest difference.
    """

    name: str
    samples: int
    outputs: float
    derivatives: float
    worst_output: str

    @property
    def agrees(self) -> bool:
        """True if the worst differences of outputs and of derivatives are within
        `AGREEMENT_TOLERANCE`."""
        return max(self.outputs, self.derivatives) <= AGREEMENT_TOLERANCE


def compare(
    function: ca.Function,
    compiled: NumericFunction,
    bounds: Mapping[str, tuple[Array, Array]],
    rng: np.random.Generator,
    samples: int = 20,
    cache: Cache | None = None,
) -> Agreement:
    """Compare a compiled function and its compiled derivative with CasADi's interpreter.

    Args:
        function: the CasADi function from which `compiled` was made.
        compiled: the function to check.
        bounds: by input name, lower and upper bounds of uniformly drawn inputs. Other inputs are
            standard normal.
        rng: random generator of the inputs.
        samples: number of random inputs.
        cache: cache of the compiled derivative; None for the user's.
    """
    interpreted = InterpretedFunction(function)
    derivative = directional_derivative(function)
    compiled_derivative = compile_function(derivative, cache)
    reference_derivative = InterpretedFunction(derivative)
    worst, worst_derivative = (0.0, ""), (0.0, "")
    for _ in range(samples):
        inputs = [
            rng.uniform(*bounds[label]) if label in bounds else rng.standard_normal(shape)
            for label, shape in zip(compiled.input_names, compiled.input_shapes, strict=True)
        ]
        expected = interpreted(*inputs)
        worst = max(worst, _worst(expected, compiled(*inputs)))
        directions = [rng.standard_normal(shape) for shape in compiled.input_shapes]
        slope = [*inputs, *expected.values(), *directions]
        reference = reference_derivative(*slope)
        worst_derivative = max(worst_derivative, _worst(reference, compiled_derivative(*slope)))
    overall = max(worst, worst_derivative)
    return Agreement(function.name(), samples, worst[0], worst_derivative[0], overall[1])


def directional_derivative(function: ca.Function) -> ca.Function:
    """Build the function of the derivatives of a function's outputs along a direction (CasADi's
    forward mode).

    Inputs: the function's inputs; its outputs at these inputs; the direction, one array per input,
    of the input's shape. Outputs: the derivative of each output along the direction.
    """
    return dense(function).forward(1)


def relative_difference(reference: Array, other: Array) -> float:
    """Compute the largest difference of two arrays over the largest entry of the array `reference`.

    This is max abs(reference - other) / max abs(reference), both over the finite entries; the
    divisor is at least `RESIDUE`. The result is infinite if NaN or infinite entries of one array
    are not equal in the other.
    """
    finite = np.isfinite(reference)
    if not np.array_equal(reference[~finite], other[~finite], equal_nan=True):
        return np.inf
    if not np.isfinite(other[finite]).all():
        return np.inf
    if not finite.any():
        return 0.0
    scale = max(float(np.abs(reference[finite]).max()), RESIDUE)
    return float(np.abs(reference[finite] - other[finite]).max()) / scale


def _worst(expected: Mapping[str, Array], found: Mapping[str, Array]) -> tuple[float, str]:
    return max((relative_difference(expected[name], found[name]), name) for name in expected)
