"""CasADi's own evaluation behind the interface of the compiled functions."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from codegen.errors import CodegenError, SlowerWarning
from codegen.function import NumericFunction
from codegen.signature import Signature
from symbolic.array import Array

if TYPE_CHECKING:
    import casadi as ca


class InterpretedFunction(NumericFunction):
    """A CasADi function evaluated by CasADi's interpreter: the same results, slower.

    Attributes:
        function: what it wraps.
    """

    def __init__(self, function: ca.Function) -> None:
        """Wrap a function whose inputs and outputs are dense (`codegen.source.dense`)."""
        super().__init__(Signature.of(function))
        self.function = function

    def _evaluate_block(self, inputs: Sequence[Array], block: NDArray[np.void]) -> None:
        self._evaluate_into(inputs, [block[name] for name in self.output_names])

    def _evaluate_into(self, inputs: Sequence[Array], outputs: Sequence[Array]) -> None:
        buffer, evaluate = self.function.buffer()
        for i, array in enumerate(inputs):
            buffer.set_arg(i, array.data)
        for i, array in enumerate(outputs):
            buffer.set_res(i, array.data)
        evaluate()
        if buffer.ret():
            raise CodegenError(f"{self.name}: the function failed")

    def _prepared(
        self, inputs: Sequence[Array], batched: Sequence[bool], outputs: Sequence[Array]
    ) -> tuple[Callable[[int], None], None]:
        buffers = []
        for k in range(len(outputs[0]) if outputs else 0):
            buffer, evaluate = self.function.buffer()
            for i, (array, per_candidate) in enumerate(zip(inputs, batched, strict=True)):
                buffer.set_arg(i, (array[k, ...] if per_candidate else array).data)
            for i, array in enumerate(outputs):
                buffer.set_res(i, array[k, ...].data)
            buffers.append((buffer, evaluate))

        def run(count: int, _memory: object = (inputs, outputs)) -> None:
            for buffer, evaluate in buffers[:count]:
                evaluate()
                if buffer.ret():
                    raise CodegenError(f"{self.name}: the function failed")

        return run, None

    def _evaluate_batch(
        self,
        inputs: Sequence[Array],
        batched: Sequence[bool],
        outputs: Sequence[Array],
        n: int,
        threads: int,
    ) -> None:
        for k in range(n):
            # With the ellipsis a scalar stays an array that shares the batch's memory.
            chosen = [
                array[k, ...] if per_candidate else array
                for array, per_candidate in zip(inputs, batched, strict=True)
            ]
            self._evaluate_into(chosen, [output[k, ...] for output in outputs])


_warned = False


def warn_interpreted() -> None:
    """Tell once per process that functions are interpreted for want of a compiler."""
    global _warned
    if _warned:
        return
    _warned = True
    warnings.warn(
        "no C compiler was found (environment variable CC, then cc, gcc, clang): functions are "
        "interpreted, which is much slower; install gcc or clang, or set CC",
        SlowerWarning,
        stacklevel=3,
    )
