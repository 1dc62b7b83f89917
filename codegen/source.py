"""From a CasADi function to self-contained C text with a batch driver."""

from __future__ import annotations

from importlib.resources import files
from itertools import accumulate

import casadi as ca

from codegen.errors import CodegenError

_DRIVER = """
#if defined(__GNUC__)
#define DUAL_ARM_EXPORT __attribute__((visibility("default")))
#else
#define DUAL_ARM_EXPORT
#endif

/* An argument or result: its first candidate, and the step to the next in doubles. */
typedef struct { casadi_real* base; long long step; } dual_arm_port;

/* Work memory of one thread. */
typedef struct {
  const casadi_real** arg; casadi_real** res; casadi_int* iw; casadi_real* w;
} dual_arm_work;

static volatile int dual_arm_lock = 0;

static void dual_arm_acquire(void) { while (__sync_lock_test_and_set(&dual_arm_lock, 1)) {} }

DUAL_ARM_EXPORT void dual_arm_load(void) { @NAME@_incref(); }

DUAL_ARM_EXPORT void dual_arm_sizes(long long* sizes) {
  casadi_int arg, res, iw, w;
  @NAME@_work(&arg, &res, &iw, &w);
  sizes[0] = arg; sizes[1] = res; sizes[2] = iw; sizes[3] = w;
}

/* Evaluate once: arguments by address, results one after the other in a block. Returns as
   dual_arm_run. */
DUAL_ARM_EXPORT long long dual_arm_once(const casadi_real* const* inputs, casadi_real* block,
                                        const dual_arm_work* work) {
  static const long long offsets[] = {@OFFSETS@};
  long long failed = -1;
  int mem, i;
  dual_arm_acquire();
  mem = @NAME@_checkout();
  __sync_lock_release(&dual_arm_lock);
  if (mem < 0) return -2;
  for (i = 0; i < @N_IN@; ++i) work->arg[i] = inputs[i];
  for (i = 0; i < @N_OUT@; ++i) work->res[i] = block + offsets[i];
  if (@NAME@(work->arg, work->res, work->iw, work->w, mem)) failed = 0;
  dual_arm_acquire();
  @NAME@_release(mem);
  __sync_lock_release(&dual_arm_lock);
  return failed;
}

/* Evaluate candidates begin to end. Returns -1, or the first candidate that failed, or -2 where
   too many evaluations run at once. */
DUAL_ARM_EXPORT long long dual_arm_run(const dual_arm_port* ports, const dual_arm_work* work,
                                       long long begin, long long end) {
  const dual_arm_port* results = ports + @N_IN@;
  long long failed = -1, k;
  int mem, i;
  dual_arm_acquire();
  mem = @NAME@_checkout();
  __sync_lock_release(&dual_arm_lock);
  if (mem < 0) return -2;
  for (k = begin; k < end; ++k) {
    for (i = 0; i < @N_IN@; ++i)
      work->arg[i] = ports[i].base ? ports[i].base + k * ports[i].step : 0;
    for (i = 0; i < @N_OUT@; ++i)
      work->res[i] = results[i].base ? results[i].base + k * results[i].step : 0;
    if (@NAME@(work->arg, work->res, work->iw, work->w, mem)) { failed = k; break; }
  }
  dual_arm_acquire();
  @NAME@_release(mem);
  __sync_lock_release(&dual_arm_lock);
  return failed;
}
"""


def dense(function: ca.Function) -> ca.Function:
    """The same function with dense inputs and outputs.

    Entries of a dense input outside the sparsity that the function was made for are ignored.
    """
    inputs = [function.sparsity_in(i) for i in range(function.n_in())]
    outputs = [function.sparsity_out(i) for i in range(function.n_out())]
    if all(sparsity.is_dense() for sparsity in inputs + outputs):
        return function
    symbols = [
        ca.MX.sym(name, *sparsity.shape)
        for name, sparsity in zip(function.name_in(), inputs, strict=True)
    ]
    results = function.call(symbols)
    return ca.Function(
        function.name(),
        symbols,
        [ca.densify(result) for result in results],
        function.name_in(),
        function.name_out(),
    )


def c_source(function: ca.Function) -> str:
    """C text of a dense CasADi function: what CasADi generates, then the batch driver.

    Raises:
        CodegenError: CasADi cannot write this function as C (a callback, an external solver).
    """
    try:
        generator = ca.CodeGenerator(function.name(), {"main": False, "mex": False})
        generator.add(function)
        generated = str(generator.dump())
    except RuntimeError as error:
        reason = str(error).splitlines()[-1]
        raise CodegenError(
            f"{function.name()}: CasADi cannot generate C for it: {reason}"
        ) from error
    sizes = [function.numel_out(i) for i in range(function.n_out())]
    driver = (
        _DRIVER.replace("@NAME@", function.name())
        .replace("@N_IN@", str(function.n_in()))
        .replace("@N_OUT@", str(function.n_out()))
        .replace("@OFFSETS@", ", ".join(map(str, accumulate(sizes, initial=0))))
    )
    # Our arithmetic comes after the library's declarations, which it shadows.
    include = "#include <math.h>\n"
    arithmetic = files("codegen").joinpath("c/arithmetic.h").read_text()
    return generated.replace(include, include + arithmetic, 1) + driver


def operations(function: ca.Function) -> int:
    """Number of instructions that one evaluation runs.

    Nested calls count with all their instructions, as often as they run; an instruction on a
    whole vector counts once.
    """
    return _operations(function, {})


def _operations(function: ca.Function, known: dict[int, int]) -> int:
    key = hash(function)
    if key not in known:
        known[key] = _count(function, known)
    return known[key]


def _count(function: ca.Function, known: dict[int, int]) -> int:
    if function.is_a("SXFunction"):
        return int(function.n_instructions())
    if function.is_a("MXFunction"):
        total = 0
        for k in range(function.n_instructions()):
            if function.instruction_id(k) == ca.OP_CALL:
                total += _operations(function.instruction_MX(k).which_function(), known)
            else:
                total += 1
        return total
    inner = function.find_functions(0)
    if function.is_a("Map"):
        return _repeats(function, inner[0]) * _operations(inner[0], known)
    return 1 + sum(_operations(f, known) for f in inner)


def _repeats(function: ca.Function, inner: ca.Function) -> int:
    """How often a map runs its inner function: its arguments and results are that many."""
    part = inner.nnz_in() + inner.nnz_out()
    return int((function.nnz_in() + function.nnz_out()) // part) if part else 1
