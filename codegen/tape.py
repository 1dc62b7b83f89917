"""Run scalar CasADi functions (type SX) without a compiler, for many samples at once.

A compiler needs seconds for a function of ten thousand instructions; listing the instructions (the
tape) takes milliseconds. `tape.cpp` decodes each instruction once and runs it for up to 32 samples.
The results have the same bits as those of a function compiled in lanes. One evaluation takes as
long as eight.
"""

from __future__ import annotations

import ctypes
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from codegen.function import NativeCall, NumericFunction, Signature, ports
from symbolic.array import Array
from symbolic.extension import compiled_module

if TYPE_CHECKING:
    import casadi as ca

_INSTRUCTION = np.dtype([("code", np.int32, 4), ("constant", np.float64)])
"""The operation's number in `tape.cpp`, its result's slot and its operands' slots; of an input or
output the operands are its place."""


@cache
def compiled_tape() -> Any:
    """Import the C++ extension module that runs tapes, and return the module.

    Raises:
        BridgeError: the module is missing or cannot be loaded.
    """
    return compiled_module("codegen._tape", "the compiled part of the interpreter")


@dataclass(frozen=True)
class Tape:
    """The instructions of a scalar CasADi function (type SX).

    Attributes:
        signature: names and shapes of the function's inputs and outputs.
        instructions: (n,) records in the order in which they run.
        slots: number of intermediate values in the work memory.
    """

    signature: Signature
    instructions: NDArray[np.void]
    slots: int

    @classmethod
    def of(cls, function: ca.Function) -> Tape | None:
        """Return the tape of a CasADi function; sparse inputs and outputs become dense.

        The result is None if the function is not of type SX, or has an operation that `tape.cpp`
        lacks.

        Raises:
            BridgeError: the compiled module cannot be loaded.
        """
        import casadi as ca

        if not function.is_a("SXFunction"):
            return None
        names = compiled_tape().OPERATIONS
        known = {getattr(ca, f"OP_{name}"): k for k, name in enumerate(names)}
        given = [function.sparsity_in(k).find() for k in range(function.n_in())]
        made = [function.sparsity_out(k).find() for k in range(function.n_out())]
        rows: list[tuple[int, int, int, int]] = []
        constants: list[float] = []
        for k in range(function.n_instructions()):
            operation = function.instruction_id(k)
            if operation not in known:
                return None
            operands, results = function.instruction_input(k), function.instruction_output(k)
            if operation == ca.OP_INPUT:
                operands = [operands[0], given[operands[0]][operands[1]]]
            elif operation == ca.OP_OUTPUT:
                operands = [operands[0], made[results[0]][results[1]]]
            rows.append((known[operation], results[0], *operands, *[0] * (2 - len(operands))))
            constant = operation == ca.OP_CONST
            constants.append(function.instruction_constant(k) if constant else 0.0)
        slots = function.sz_w()
        zeros = [
            (k, place)
            for k, places in enumerate(made)
            for place in sorted(set(range(function.numel_out(k))) - set(places))
        ]
        if zeros:
            rows.append((names.index("CONST"), slots, 0, 0))
            rows += [(names.index("OUTPUT"), k, slots, place) for k, place in zeros]
            constants += [0.0] * (len(zeros) + 1)
        found = np.zeros(len(rows), _INSTRUCTION)
        if rows:
            found["code"], found["constant"] = rows, constants
        return cls(Signature.of(function), found, slots + bool(zeros))

    @cached_property
    def program(self) -> Any:
        """Object of the extension module that holds the instructions and runs them."""
        count = len(self.signature.input_names)
        found = (self.instructions[name] for name in ("code", "constant"))
        codes, constants = map(np.ascontiguousarray, found)
        return compiled_tape().Tape(codes, constants, count, self.slots)

    @classmethod
    def load(cls, path: Path, signature: Signature, slots: int) -> Tape:
        """Read the instructions from a file that `save` wrote.

        Args:
            path: the file.
            signature: signature of the function.
            slots: number of intermediate values in the work memory.
        """
        return cls(signature, np.load(path, allow_pickle=False), slots)

    def save(self, path: Path) -> None:
        """Write the instructions to a NumPy file. Signature and number of slots are not written;
        `load` takes them as arguments."""
        np.save(path, self.instructions, allow_pickle=False)


class TapeFunction(NumericFunction):
    """A numeric function that runs from its tape. Several threads may call it at once.

    Attributes:
        tape: the instructions of the function.
    """

    def __init__(self, tape: Tape) -> None:
        super().__init__(tape.signature)
        self.tape, self._idle = tape, deque[Any]()

    def _evaluate_block(self, inputs: Sequence[Array], block: NDArray[np.void]) -> None:
        outputs = [block[name] for name in self.output_names]
        self._evaluate_batch(inputs, [False] * len(inputs), outputs, 1, 1)

    def _evaluate_batch(
        self,
        inputs: Sequence[Array],
        batched: Sequence[bool],
        outputs: Sequence[Array],
        n: int,
        threads: int,
    ) -> None:
        of_batch = ports(self.signature, inputs, batched, outputs)
        try:
            work = self._idle.pop()
        except IndexError:
            work = compiled_tape().Work(self.tape.program)
        work.run(ctypes.addressof(of_batch), 0, n)
        self._idle.append(work)

    def _prepared(
        self, inputs: Sequence[Array], batched: Sequence[bool], outputs: Sequence[Array]
    ) -> tuple[Callable[[int], None], Callable[[], NativeCall]]:
        of_batch = ports(self.signature, inputs, batched, outputs)
        begin, work = ctypes.addressof(of_batch), compiled_tape().Work(self.tape.program)

        def run(count: int, _memory: object = (inputs, outputs, of_batch)) -> None:
            work.run(begin, 0, count)

        call = NativeCall(compiled_tape().RUN, compiled_tape().RUN, begin, *[work.address] * 2)
        return run, lambda: call
