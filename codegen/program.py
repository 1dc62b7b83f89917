"""Several CasADi functions in lanes, and C of our own that calls them, as one library.

For work in which calling through NumPy would cost more than the functions: intermediate results
stay in lanes and in the cache. Our C finds, for a function `f` of the program, `f(arg, res, iw, w)`
over `lanes_real`, the room that it needs as f_ARG, f_RES, f_IW and f_W, and the size of its k-th
result as f_OUT_k.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from codegen.cache import FORMAT, Cache, digest, source_digest
from codegen.compiled import warn_one_lane
from codegen.compiler import FLAGS, LANE_FLAGS, LANE_LEVEL, find_compiler
from codegen.errors import CodegenError
from codegen.function import available_cores
from codegen.parts import compile_parts, in_parts
from codegen.runtime import runtime

if TYPE_CHECKING:
    import casadi as ca


def load_or_build_program(
    name: str,
    key: str,
    make: Callable[[], Mapping[str, ca.Function]],
    own: str,
    cache: Cache | None = None,
    lanes: int = 0,
) -> ctypes.CDLL | None:
    """The library, from the cache where it was built before.

    Args:
        name: for messages.
        key: changes with everything that `make` depends on, except the version of CasADi.
        make: makes the functions, by the names under which our C calls them.
        own: our C, which follows the functions.
        cache: where libraries are kept; by default the user's.
        lanes: evaluations side by side; 0 for what suits the machine.

    Returns:
        The library; None where there is no compiler, where the machine or the functions have no
        form in lanes, or, with a warning, where the compiler fails.

    Raises:
        CodegenError: the cache cannot be used.
    """
    compiler = find_compiler()
    if compiler is None:
        return None
    cache = cache or Cache()
    parts = (str(FORMAT), name, key, str(lanes), compiler.identity, *FLAGS, *LANE_FLAGS)
    full = digest("program", *parts, version("casadi"), source_digest("codegen"), own)

    def find() -> tuple[ctypes.CDLL | None] | None:
        record = cache.read_record(full)
        if record is not None and not record["in_lanes"]:
            return (None,)
        entry = None if record is None else cache.find(full)
        loaded = None if entry is None else _load(entry.library)
        return None if loaded is None else (loaded,)

    found = find()
    if found is None:
        with cache.lock(full):
            found = find()
            if found is None:
                found = (_build(name, full, make(), own, cache, lanes),)
    return found[0]


def _build(
    name: str,
    key: str,
    functions: Mapping[str, ca.Function],
    own: str,
    cache: Cache,
    lanes: int,
) -> ctypes.CDLL | None:
    compiler = find_compiler()
    text = program_source(functions, own, lanes)
    if compiler is None or text is None:
        cache.write_record(key, {"in_lanes": False})
        return None

    with ThreadPoolExecutor(available_cores()) as pool:
        objects = compile_parts(*in_parts(text, lanes), compiler, cache, pool.submit)

        def write(library: Path) -> dict[str, Any]:
            objects.link(library.parent / f"{name}.c", library, LANE_LEVEL, LANE_FLAGS)
            return {"in_lanes": True}

        try:
            loaded = _load(cache.store(key, write).library)
        except CodegenError as error:
            warn_one_lane(name, str(error))
            return None
    if loaded is None:
        cache.write_record(key, {"in_lanes": False})
    return loaded


def _load(library: Path) -> ctypes.CDLL | None:
    """The library; None if it cannot be loaded or is without lanes."""
    try:
        loaded = ctypes.CDLL(str(library))
        return loaded if int(loaded.dual_arm_lanes()) > 1 else None
    except (OSError, AttributeError):
        return None


def program_source(functions: Mapping[str, ca.Function], own: str, lanes: int = 0) -> str | None:
    """C text of a program; None if a function has no form in lanes.

    Raises:
        CodegenError: CasADi cannot write a function as C.
    """
    from codegen.lanes import lane_text
    from codegen.source import dense, generated_c

    parts = ["#include <math.h>\n#include <stdlib.h>\n#include <string.h>\n"]
    parts += [runtime("arithmetic.h"), runtime("one_lane.h")]
    parts += [f"#define DUAL_ARM_LANES {lanes}\n" if lanes else "", runtime("lanes.h")]
    parts.append(
        '#define DUAL_ARM_EXPORT __attribute__((visibility("default")))\n'
        "DUAL_ARM_EXPORT long long dual_arm_lanes(void) { return DUAL_ARM_LANES; }\n"
        "#if DUAL_ARM_LANES > 1\n"
    )
    for name, function in functions.items():
        whole = dense(function)
        found = lane_text(generated_c([whole]), name)
        if found is None:
            return None
        sizes = {"ARG": whole.sz_arg(), "RES": whole.sz_res(), "IW": whole.sz_iw()}
        sizes |= {"W": whole.sz_w()}
        sizes |= {f"OUT_{i}": whole.numel_out(i) for i in range(whole.n_out())}
        parts += [f"#define {name}_{what} {size}\n" for what, size in sizes.items()]
        parts.append(found.text)
        parts.append(
            f"static int {name}(const lanes_real** arg, lanes_real** res, lanes_int* iw, "
            f"lanes_real* w) {{\n  return {found.entry}(arg, res, iw, w, 0);\n}}\n"
        )
    return "".join([*parts, own, "#endif\n"])
