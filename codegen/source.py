"""Generation of self-contained C text from CasADi functions: with a batch driver, or with own C
that calls them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from math import prod
from types import MappingProxyType

import casadi as ca

from codegen.errors import CodegenError
from codegen.function import Signature
from codegen.lanes import lane_text
from codegen.parts import runtime


def dense(function: ca.Function) -> ca.Function:
    """Return the function with dense inputs and outputs.

    Entries of a dense input outside the function's sparsity are ignored.
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


def c_source(function: ca.Function, lanes: int = 1, generated: str = "") -> str:
    """Generate the C text of a dense CasADi function: CasADi's C, then the batch drivers.

    Args:
        function: a function that CasADi can write as C.
        generated: result of `generated_c` for the function; '' to generate it.
        lanes: 1 for one evaluation at a time; otherwise the number of lanes in which batches are
            evaluated, 0 for the width of the machine that compiles.

    Raises:
        CodegenError: CasADi cannot write this function as C (a callback, an external solver), or
            its C cannot be translated to lanes.
    """
    include = "#include <math.h>\n"
    generated, signature = generated or generated_c([function]), Signature.of(function)
    shared = shared_inputs(function)
    in_lanes = None if lanes == 1 else lane_text(generated, "lanes", shared)
    before = [include, runtime("arithmetic.h")]
    after = [_filled(runtime("driver.c"), signature, generated)]
    if in_lanes is not None:
        before += _lanes_header(lanes)
        flags = ", ".join(str(int(k in shared)) for k in range(function.n_in()))
        lane_driver = _filled(runtime("lane_driver.c"), signature).replace("@SHARED@", flags or "0")
        after += [
            "\n#if DUAL_ARM_LANES > 1\n" + in_lanes.text + "#endif\n\n",
            lane_driver.replace("@LANE_FUNCTION@", in_lanes.entry),
        ]
    # Our arithmetic comes after the library's declarations, which it shadows.
    return generated.replace(include, "".join(before), 1) + "\n" + "".join(after)


def handwritten_source(
    signature: Signature,
    text: str,
    helpers: Sequence[ca.Function],
    in_pairs: Mapping[str, ca.Function] = MappingProxyType({}),
) -> str:
    """Assemble the C text of a function written by hand, with the batch driver.

    Args:
        signature: name, inputs and outputs of the function.
        text: C that defines `NAME` with CasADi's interface (arguments, results and work memory by
            address), and `NAME_work`, `NAME_incref`, `NAME_checkout`, `NAME_release`.
        helpers: dense CasADi functions that the text calls. Their C is put before the text.
        in_pairs: further CasADi functions by name, which evaluate two inputs side by side in two
            lanes; their C is put before the text too.

    Raises:
        CodegenError: CasADi cannot write a helper as C, or its C cannot be translated to lanes.
    """
    include = "#include <math.h>\n"
    generated = generated_c(helpers).replace(include, include + runtime("arithmetic.h"), 1)
    pairs = "".join([*_lanes_header(2), *_lane_functions(in_pairs)]) if in_pairs else ""
    return generated + pairs + text + _filled(runtime("driver.c"), signature)


def program_source(functions: Mapping[str, ca.Function], own: str, lanes: int = 0) -> str:
    """Generate the C text of CasADi functions in lanes, followed by handwritten C that calls them.

    Args:
        functions: CasADi functions, by the names under which `own` calls them.
        own: the handwritten C.
        lanes: number of lanes; 0 for the width of the machine that compiles.

    Raises:
        CodegenError: CasADi cannot write a function as C, or its C cannot be translated to lanes.
    """
    parts = ["#include <math.h>\n#include <stdlib.h>\n#include <string.h>\n"]
    parts += [runtime("arithmetic.h"), *_lanes_header(lanes)]
    parts.append(
        '#define DUAL_ARM_EXPORT __attribute__((visibility("default")))\n'
        "DUAL_ARM_EXPORT long long dual_arm_lanes(void) { return DUAL_ARM_LANES; }\n"
        "#if DUAL_ARM_LANES > 1\n"
    )
    return "".join([*parts, *_lane_functions(functions), own, "#endif\n"])


def _lanes_header(lanes: int) -> list[str]:
    """Return pieces of C text that define the C types of lanes and the arithmetic on them. A value
    of such a type holds one number per lane, for evaluations side by side.

    Args:
        lanes: number of lanes; 0 for the width of the machine that compiles.
    """
    width = f"#define DUAL_ARM_LANES {lanes}\n" if lanes else ""
    return [runtime("one_lane.h"), width, runtime("lanes.h")]


def _lane_functions(functions: Mapping[str, ca.Function]) -> Iterator[str]:
    """Yield the C text of functions in lanes. Each is called as `NAME(arg, res, iw, w)`, with
    CasADi's arguments, results and work memory, as arrays of `lanes_real`.

    Macros state the sizes of the work memory (NAME_ARG, NAME_RES, NAME_IW, NAME_W) and of result k
    (NAME_OUT_k). NAME_SHARED is 1 if arguments named with `SHARED_SUFFIX` are passed as plain
    numbers, else 0.

    Args:
        functions: the CasADi functions by name.
    """
    for name, function in functions.items():
        whole = dense(function)
        shared = shared_inputs(whole)
        found = lane_text(generated_c([whole]), name, shared)
        sizes = {"ARG": whole.sz_arg(), "RES": whole.sz_res(), "IW": whole.sz_iw()}
        sizes |= {"W": whole.sz_w(), "SHARED": int(bool(shared))}
        sizes |= {f"OUT_{i}": whole.numel_out(i) for i in range(whole.n_out())}
        yield from (f"#define {name}_{what} {size}\n" for what, size in sizes.items())
        yield found.text
        yield (
            f"static int {name}(const lanes_real** arg, lanes_real** res, lanes_int* iw, "
            f"lanes_real* w) {{\n  return {found.entry}(arg, res, iw, w, 0);\n}}\n"
        )


SHARED_SUFFIX = "_numbers"
"""Ending of the names of inputs with one value for all evaluations of a batch."""


def shared_inputs(function: ca.Function) -> tuple[int, ...]:
    """Return the indices of the inputs of a function that have one value for all lanes.

    These are the inputs of functions over SX whose names end in `SHARED_SUFFIX`. Functions over MX
    have none.
    """
    straight = function.is_a("SXFunction")
    names = enumerate(function.name_in())
    return tuple(k for k, name in names if straight and name.endswith(SHARED_SUFFIX))


def generated_c(functions: Sequence[ca.Function]) -> str:
    """Generate CasADi's C text of one or more dense functions.

    Raises:
        CodegenError: CasADi cannot write one of the functions as C.
    """
    name = functions[0].name()
    try:
        generator = ca.CodeGenerator(name, {"main": False, "mex": False})
        for function in functions:
            generator.add(function)
        return str(generator.dump())
    except RuntimeError as error:
        reason = str(error).splitlines()[-1]
        raise CodegenError(f"{name}: CasADi cannot generate C for it: {reason}") from error


def _filled(driver: str, signature: Signature, generated: str = "") -> str:
    """Fill the placeholders of a batch driver's C text for one function.

    Args:
        driver: C text with placeholders.
        signature: name and sizes of the function.
        generated: CasADi's C code of the function, which shows whether the function keeps state
            between calls; '' for code without state.
    """
    inputs = [prod(shape) for shape in signature.input_shapes]
    outputs = [prod(shape) for shape in signature.output_shapes]
    return (
        driver.replace("@NAME@", signature.name)
        .replace("@N_IN@", str(len(inputs)))
        .replace("@N_OUT@", str(len(outputs)))
        .replace("@STATE@", str(int("_mem_counter" in generated)))
        .replace("@SIZES@", ", ".join(map(str, [*inputs, *outputs, 0])))
    )


def operations(function: ca.Function, left_out: frozenset[str] = frozenset()) -> int:
    """Count the instructions that one evaluation of a CasADi function runs.

    Nested calls count with all their instructions, as often as they run. An `if_else` counts with
    both branches. An instruction on a whole vector counts once.

    Args:
        function: the function.
        left_out: names of functions that do not count.
    """
    return _operations(function, {}, left_out)


def _operations(function: ca.Function, known: dict[int, int], left_out: frozenset[str]) -> int:
    key = hash(function)
    if function.name() in left_out:
        return 0
    if key not in known:
        known[key] = _count(function, known, left_out)
    return known[key]


def _count(function: ca.Function, known: dict[int, int], left_out: frozenset[str]) -> int:
    if function.is_a("SXFunction"):
        return int(function.n_instructions())
    if function.is_a("MXFunction"):
        total = 0
        for k in range(function.n_instructions()):
            if function.instruction_id(k) == ca.OP_CALL:
                total += _operations(function.instruction_MX(k).which_function(), known, left_out)
            else:
                total += 1
        return total
    inner = function.find_functions(0)
    total = sum(_operations(f, known, left_out) for f in inner)
    if not function.is_a("Map"):
        return 1 + total
    # Arguments and results of a map are so many times those of its inner function.
    part = inner[0].nnz_in() + inner[0].nnz_out()
    return (int((function.nnz_in() + function.nnz_out()) // part) if part else 1) * total
