"""How much of what a core can do an evaluation uses."""

from __future__ import annotations

import ctypes
import time

from codegen.build import load_or_build_program
from codegen.source import operations
from symbolic.cell_model import CellModel
from symbolic.functions import kernel_functions

ROUNDS = 2_000_000
BEST_OF = 5

RARE = frozenset({"closer", "again", "held"})
"""Branches of `symbolic.robot.arm.track_function`."""

_LOOP = """
/* Additions and multiplications that wait for nothing but their own last one. */
DUAL_ARM_EXPORT double dual_arm_peak(long long rounds) {
  lanes_real a[8], m[8], step = lanes_all_equal(1e-9), factor = lanes_all_equal(1.0 + 1e-16);
  for (int i = 0; i < 8; ++i) a[i] = m[i] = lanes_all_equal(1.0 + i);
  for (long long k = 0; k < rounds; ++k) {
#pragma GCC unroll 8
    for (int i = 0; i < 8; ++i) {
      a[i] = a[i] + step;
      m[i] = m[i] * factor;
    }
  }
  lanes_real sum = lanes_all_equal(0.0);
  for (int i = 0; i < 8; ++i) sum += a[i] + m[i];
  return sum[0];
}
"""


def peak_operations() -> float | None:
    """Additions and multiplications per second that one core does in lanes; None without lanes.

    Measured: the best of some runs of a loop of sixteen independent chains.
    """
    library = load_or_build_program("peak", "peak", dict, _LOOP)
    if library.dual_arm_lanes() < 2:
        return None
    loop = library.dual_arm_peak
    loop.argtypes, loop.restype = [ctypes.c_longlong], ctypes.c_double
    times = []
    for _ in range(BEST_OF):
        start = time.thread_time()
        loop(ROUNDS)
        times.append(time.thread_time() - start)
    return 16.0 * ROUNDS * int(library.dual_arm_lanes()) / min(times)


def candidate_operations(model: CellModel) -> int:
    """Operations of one candidate with collisions, counted in its CasADi functions.

    Without the branches that few samples take; a sine or cosine counts as one.
    """
    functions = kernel_functions(model)
    each = sum(operations(functions[name], RARE) for name in ("sample", "clearance"))
    return operations(functions["path"]) + model.workcell.task.samples * each
