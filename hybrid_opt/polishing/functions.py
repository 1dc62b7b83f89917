"""The compiled parts of the smooth problem of a workcell."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca

from codegen.build import build, load_or_build
from codegen.cache import digest
from codegen.compiled import CompiledFunction
from codegen.function import NumericFunction
from codegen.interpreted import InterpretedFunction
from hybrid_opt.evaluate.functions import workcell_key
from symbolic.cell_model import build_cell_model
from symbolic.errors import SettingsError
from symbolic.smooth.forces import force_functions, pressure_functions
from symbolic.smooth.rows import RowFunctions, solve_function
from symbolic.workcell.records import Workcell

_LEVELS = {
    "force_inner_hessian": 1,
    "pressure_inner_hessian": 0,
    "pressure_first_hessian": 0,
    "pressure_last_hessian": 0,
    "force_first_hessian": 0,
    "force_last_hessian": 0,
    "hessian_singularity_0_1": 0,
    "hessian_singularity_0_2": 0,
    "solve_1": 1,
    "solve_2": 1,
}
"""Optimisation levels of the compiler where size alone would choose too high a one: these are
straight-line code, and those at 0 are called a few times per iteration."""


@dataclass(frozen=True)
class PolishFunctions:
    """What the smooth problems of a workcell are assembled from.

    Attributes:
        samples: see `symbolic.smooth.forces`: of forces and pressure.
        solve: inverse kinematics of both arms, see `symbolic.smooth.rows.solve_function`.
        joints: the same two, for NumPy.
        rows: makes the constraints at places of the path.
    """

    samples: Mapping[str, ca.Function]
    solve: tuple[ca.Function, ca.Function]
    joints: tuple[NumericFunction, NumericFunction]
    rows: RowFunctions


def polish_functions(workcell: Workcell) -> PolishFunctions:
    """Load or build the functions of a workcell's smooth problem.

    Of the rows at places of the path the frequent ones are compiled; the others are interpreted.

    Raises:
        SettingsError: the time law is 'optimal', which is no smooth function of the path.
        DualArmError: the cell's model cannot be built, or its functions not be compiled.
    """
    if workcell.task.time_law == "optimal":
        raise SettingsError(
            "the polish does not know the time law 'optimal'; search without it (--no-polish), or "
            "polish under 'constant' or 'ramped'"
        )
    model = build_cell_model(workcell)

    def make() -> Mapping[str, ca.Function]:
        solve = {f"solve_{arm + 1}": solve_function(model, arm) for arm in (0, 1)}
        samples = {**force_functions(workcell), **pressure_functions(workcell)}
        return {**samples, **solve, **RowFunctions(model).frequent()}

    if workcell.digest:
        key = digest("polish", str(_LEVELS), workcell_key(workcell))
        compiled = load_or_build(key, make, levels=_LEVELS)
    else:
        compiled = build(make(), levels=_LEVELS).functions
    usable = {name: as_casadi(function) for name, function in compiled.items()}
    return PolishFunctions(
        samples={name: f for name, f in usable.items() if name.startswith(("force", "pressure"))},
        solve=(usable["solve_1"], usable["solve_2"]),
        joints=(compiled["solve_1"], compiled["solve_2"]),
        rows=RowFunctions(model, usable),
    )


def as_casadi(function: NumericFunction) -> ca.Function:
    """A built function as CasADi calls it, without derivatives."""
    if isinstance(function, CompiledFunction):
        return ca.external(function.name, str(function.library))
    assert isinstance(function, InterpretedFunction)
    return function.function
