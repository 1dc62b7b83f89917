"""What a call costs beside the computation: `python -m tests.codegen.overhead`.

Times empty work (each output a copy of one input entry) through every way to call a function, and
CasADi's own buffer beside it, in the same run.
"""

from __future__ import annotations

import timeit
from collections.abc import Callable

import casadi as ca
import numpy as np

from codegen.build import compile_function
from codegen.interpreted import InterpretedFunction

_CALLS = 20_000
_ROUNDS = 7


def copying(n_out: int) -> ca.Function:
    """A function of x (18,) with `n_out` outputs, each one entry of x."""
    x = ca.MX.sym("x", 18)
    names = [f"y{k}" for k in range(n_out)]
    return ca.Function(f"copying_{n_out}", [x], [x[k % 18] for k in range(n_out)], ["x"], names)


def microseconds(call: Callable[[], object]) -> float:
    """Best mean time of a call over several rounds [us]."""
    return min(timeit.repeat(call, number=_CALLS, repeat=_ROUNDS)) / _CALLS * 1e6


def measure(n_out: int) -> dict[str, float]:
    """Microseconds per call, by way of calling, for a function of one input."""
    function = copying(n_out)
    compiled, interpreted = compile_function(function), InterpretedFunction(function)
    x = np.arange(18.0)
    batch = np.tile(x, (64, 1))
    outputs = [np.empty(shape) for shape in compiled.output_shapes]
    buffer, evaluate = function.buffer()
    buffer.set_arg(0, x.data)
    for k, output in enumerate(outputs):
        buffer.set_res(k, output.data)
    return {
        "call": microseconds(lambda: compiled(x)),
        "batch of 64": microseconds(lambda: compiled.batch(batch)),
        "interpreted call": microseconds(lambda: interpreted(x)),
        "interpreted, bound CasADi buffer": microseconds(evaluate),
    }


def main() -> None:
    """Print the table."""
    counts = (1, 5, 20)
    columns = [measure(n_out) for n_out in counts]
    print(f"{'microseconds per call, outputs:':34s}" + "".join(f"{n:8d}" for n in counts))
    for way in columns[0]:
        print(f"{way:34s}" + "".join(f"{column[way]:8.2f}" for column in columns))


if __name__ == "__main__":
    main()
