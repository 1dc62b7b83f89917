"""The evaluators of a workcell, compiled."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import version
from typing import TYPE_CHECKING

from codegen.build import build, load_or_build
from codegen.cache import Cache, digest, source_digest
from codegen.function import NumericFunction
from symbolic.workcell.records import Workcell

if TYPE_CHECKING:
    import casadi as ca


def workcell_functions(
    workcell: Workcell, cache: Cache | None = None
) -> dict[str, NumericFunction]:
    """Every function of `symbolic.functions.cell`, from the cache where it was built before.

    A first use builds expressions and compiles; later ones, also by other processes, only load.

    Raises:
        DualArmError: the workcell has no model, or its functions cannot be built.
    """

    def make() -> Mapping[str, ca.Function]:
        # Not imported at the top: a warm start needs neither CasADi nor Pinocchio.
        from symbolic.functions.cell import cell_functions

        return cell_functions(workcell)

    if not workcell.digest:
        # Not read from a file: nothing identifies it but the functions themselves.
        return build(make(), cache, lanes=0).functions
    return load_or_build(workcell_key(workcell), make, cache, lanes=0)


def workcell_key(workcell: Workcell) -> str:
    """What a workcell's functions are made from: its files, the symbolic package's sources and
    the libraries that write the expressions (CasADi's version is part of every set's key)."""
    libraries = [f"{library} {version(library)}" for library in ("pin", "scipy")]
    law = workcell.task.time_law
    return digest(workcell.digest, law, source_digest("symbolic"), *libraries)
