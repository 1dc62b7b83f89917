"""A workcell's compiled functions, all made from one symbolic model."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np

from codegen.build import compiler_of, load_or_build
from codegen.cache import Cache, key_of, library_version
from codegen.function import NumericFunction
from symbolic.array import Array
from symbolic.contact.registry import contact_model
from symbolic.records import Workcell
from symbolic.records.task import initial_decision

if TYPE_CHECKING:
    import casadi as ca

    from symbolic.cell_model import CellBodies, CellModel
    from symbolic.geometry.pairs import CellGeometry
    from symbolic.parameters import CellParameters, WorkcellParameters
    from symbolic.robot.branches import ArmSearch

Loaded = TypeVar("Loaded")

CACHED_WORKCELLS = 2
"""Number of workcells for which functions of a workcell, such as `robust_model`, keep results."""


class CompiledCell:
    """Compiled functions of a workcell, built in sets on first use. Share one object wherever
    several sets are needed.

    A set that was built before, also by another process, is loaded from the cache without the
    symbolic model. Otherwise it is built from the symbolic model, which is made once.

    Attributes:
        workcell: description of the cell.
        cache: cache of compiled libraries, None for the user's cache.
        is_compiled: True, except for an `InterpretedCell`.
    """

    is_compiled: ClassVar[bool] = True

    def __init__(
        self, workcell: Workcell, cache: Cache | None = None, model: CellModel | None = None
    ) -> None:
        """Describe the cell; nothing is built yet.

        Args:
            workcell: description of the cell.
            cache: cache of compiled libraries, None for the user's cache.
            model: symbolic model of the cell if it does not follow from the workcell alone, for
                example with other start postures; None to build it from the workcell.

        Raises:
            CodegenError: there is no C compiler, and the cache knows of none.
        """
        if self.is_compiled:
            compiler_of(cache or Cache())
        self.workcell = workcell
        self.cache = cache
        self._given = model
        self._is_changed = False
        self._loaded: dict[object, Any] = {}

    def with_parameters(self, workcell: Workcell) -> CompiledCell:
        """Return the compiled functions of another workcell, which differs only in parameters:
        numbers that are inputs of compiled functions. Both objects share the loaded libraries."""
        other = CompiledCell(workcell, self.cache)
        other._loaded, other._is_changed = self._loaded, True
        return other

    def memoise(self, key: object, load: Callable[[], Loaded]) -> Loaded:
        """Return the object stored under a key in memory; call `load` and store its result if there
        is none. Objects made by `with_parameters` share the store.

        Args:
            key: key of the object, which has to be hashable.
            load: function that makes the object.
        """
        if key not in self._loaded:
            self._loaded[key] = load()
        found: Loaded = self._loaded[key]
        return found

    @classmethod
    def of(cls, cell: Workcell | CompiledCell) -> CompiledCell:
        """Return the compiled functions of a cell; a `CompiledCell` is returned unchanged."""
        return cell if isinstance(cell, CompiledCell) else cls(cell)

    @cached_property
    def model(self) -> CellModel:
        """The symbolic model of the cell with the values of its parameters; in `symbols` they are
        symbols.

        Raises:
            DualArmError: the model cannot be built.
        """
        # Not imported at the top: a warm start needs neither CasADi nor Pinocchio.
        from symbolic.cell_model import build_cell_model

        if self._given is not None:
            return self._given
        return build_cell_model(self.workcell, self.bodies, self._searches())

    def _searches(self) -> tuple[ArmSearch, ArmSearch] | None:
        """Return for each arm the search for its start branches, which uses compiled functions;
        None for an `InterpretedCell`."""
        from symbolic.cell_model import own_clearance
        from symbolic.robot.branches import ArmSearch

        def make(model: CellModel) -> Mapping[str, ca.Function]:
            from symbolic.functions import branch_functions

            return branch_functions(model)

        found = self.functions("branches", make, lanes=0, bodies=False, taped=True)
        geometry = self.geometry
        asked = [self.screening[f"{block}clearance"] for block in geometry.asked]

        def bounds(poses: Array, q_1: Array, q_2: Array) -> Array:
            parts = [function.batch(poses, q_1, q_2)["clearance"] for function in asked]
            return np.column_stack(parts).take(geometry.columns, axis=1)

        def poses(waypoints: Array) -> Array:
            return found["poses"](waypoints)["poses"]

        def search(arm: int) -> ArmSearch:
            approach, follow = (found[f"{name}_{arm + 1}"] for name in ("approach", "follow"))

            def along(starts: Array, extended: Array) -> Mapping[str, Array]:
                return follow.batch(starts, extended, np.zeros((len(extended), 6)))

            postures = self.memoise(("postures", arm, self.numbers.digest), dict[bytes, Array])
            clearance = own_clearance(geometry, arm, bounds)
            return ArmSearch(approach.batch, along, poses, clearance, postures)

        return search(0), search(1)

    @cached_property
    def bodies(self) -> CellBodies:
        """Arms and collision bodies, without start postures.

        Raises:
            DualArmError: a robot description or a shape cannot be read.
        """
        if self._given is not None:
            return self._given
        from symbolic.cell_model import build_cell_bodies

        return build_cell_bodies(self.workcell)

    @property
    def geometry(self) -> CellGeometry:
        """Collision bodies of the cell, and the pairs of bodies that are checked for collision."""
        return self.bodies.geometry

    @cached_property
    def numbers(self) -> CellParameters:
        """Parameters of the cell, numbers that are inputs of compiled functions; and its topology,
        everything whose change needs a new compilation."""
        from symbolic.parameters import CellParameters

        bodies = self.bodies
        return CellParameters(self.workcell, bodies.screen, bodies.robots)

    @cached_property
    def symbols(self) -> CellModel:
        """The symbolic model of the cell with symbols for its parameters, which are inputs of its
        functions; in `model` they have values."""
        return self.numbers.symbolic(self.bodies)

    @cached_property
    def start(self) -> tuple[Array, Array]:
        """(n_joints,) joint positions of each arm at the first waypoint [rad].

        Raises:
            DualArmError: the model cannot be built.
        """
        if self._given is not None or "model" in vars(self):
            return self.model.start
        # Found by a search, which does not know what is held: kept.
        from symbolic.parameters import HELD, SQUEEZES

        cache, task = self.cache or Cache(), self.workcell.task
        names = [name for name in self.numbers.sizes if name not in (HELD, *SQUEEZES)]
        values = [self.numbers.vector(name) for name in names]
        chosen = np.array(self.workcell.start_branch), self.geometry.columns
        of = [*values, initial_decision(task), *chosen]
        found_by = compiler_of(cache).identity
        key = self.key("start", found_by, *[value.tobytes().hex() for value in of])

        def find() -> tuple[Array, Array]:
            if self._is_changed:  # one of many that are tried out
                return self.model.start
            record = cache.read_record(key)
            if record is None:
                record = {"joints": [q.tolist() for q in self.model.start]}
                cache.write_record(key, record)
            first, second = (np.array(q) for q in record["joints"])
            return first, second

        return self.memoise(key, find)

    def vector(self, group: str) -> Array:
        """Return the values (n,) of one group of parameters.

        Args:
            group: name of the group, one of `symbolic.parameters.GROUPS`.
        """
        from symbolic.parameters import START

        return np.concatenate(self.start) if group == START else self.numbers.vector(group)

    def key(self, name: str, *details: str, bodies: bool = True) -> str:
        """Return the key under which a set of functions is cached.

        The key depends on the topology of the cell, on the source code that makes the expressions,
        and on the versions of Pinocchio and SciPy. The version of CasADi is added for every set.

        Args:
            name: name of the set.
            details: further values on which the functions depend.
            bodies: True if the functions depend on the collision bodies.
        """
        numbers = self.numbers
        return key_of(
            name,
            structure=numbers.bodies_digest if bodies else numbers.digest,
            expressions=_expressions((self.cache or Cache()).folder),
            libraries=[f"{name} {library_version(name)}" for name in ("pin", "scipy")],
            details=details,
        )

    def functions(
        self,
        name: str,
        make: Callable[[CellModel], Mapping[str, ca.Function]],
        *details: str,
        lanes: int = 1,
        levels: Mapping[str, int] | None = None,
        bodies: bool = True,
        taped: bool = False,
    ) -> dict[str, NumericFunction]:
        """Return a set of compiled functions by name, with the parameters of this cell filled in.

        The set is loaded from the cache if it was built before for a cell of the same topology.

        Args:
            name: name of the set.
            make: function that makes the CasADi functions from the symbolic model `symbols`.
            details: further values on which the functions depend.
            lanes: number of evaluations of a batch that run side by side; 0 for the machine's
                width.
            levels: optimisation levels of the compiler by name of the function. The size of the C
                text decides the level of other functions; None for all.
            bodies: True if the functions depend on the collision bodies.
            taped: True to compile only functions with CasADi's MX expressions. Functions with SX
                expressions are stored as tapes, lists of operations that an interpreter runs.

        Raises:
            DualArmError: the model or its code cannot be built.
        """
        key = self.key(name, *details, bodies=bodies)
        built = self.memoise(
            (key, lanes, str(levels), taped),
            lambda: load_or_build(
                key, lambda: make(self.symbols), self.cache, lanes=lanes, levels=levels, taped=taped
            ),
        )
        return {name: self.bound(function) for name, function in built.items()}

    def bound(self, function: NumericFunction) -> NumericFunction:
        """Return a function whose last inputs, the parameters, are filled in from this cell."""
        from symbolic.parameters import GROUPS

        return function.bound(
            {name: self.vector(name) for name in function.input_names if name in GROUPS}
        )

    @cached_property
    def evaluators(self) -> dict[str, NumericFunction]:
        """All functions of `symbolic.functions.cell_functions`, compiled, by name."""

        def make(model: CellModel) -> Mapping[str, ca.Function]:
            from symbolic.functions import arm_functions

            return arm_functions(model)

        arms = self.functions(EVALUATORS, make, lanes=EVALUATOR_LANES, bodies=False)
        return arms | self.screening

    @cached_property
    def screening(self) -> dict[str, NumericFunction]:
        """The compiled functions that depend on the collision bodies, by name."""

        def make(model: CellModel) -> Mapping[str, ca.Function]:
            return model.screening

        return self.functions(SCREENING, make, lanes=EVALUATOR_LANES)


class InterpretedCell(CompiledCell):
    """Functions of a workcell that CasADi's interpreter evaluates; nothing is compiled.

    It suits a few hundred evaluations. One evaluation takes fifty times as long as a compiled one,
    but compiling the functions of a new cell takes a minute.
    """

    is_compiled = False

    def _searches(self) -> None:
        return None

    @cached_property
    def start(self) -> tuple[Array, Array]:
        """(n_joints,) joint positions of each arm at the first waypoint [rad]."""
        return self.model.start

    def functions(
        self,
        name: str,
        make: Callable[[CellModel], Mapping[str, ca.Function]],
        *details: str,
        **choices: Any,
    ) -> dict[str, NumericFunction]:
        """Return a set of interpreted functions of this cell by name.

        Args:
            name: ignored, as `details` and `choices` are: nothing is cached.
            make: function that makes the CasADi functions from the symbolic model.
            details: ignored.
            choices: ignored.
        """
        from codegen.interpreted import interpret

        return {name: interpret(function) for name, function in make(self.model).items()}


def is_interpretable(workcell: Workcell) -> bool:
    """Return True if CasADi's interpreter evaluates a candidate in milliseconds.

    It does if the contact forces have a closed form and the time law is not drivable.
    """
    return contact_model(workcell).has_closed_form and not workcell.task.law.is_drivable


@lru_cache
def _expressions(folder: Path) -> str:
    """Return the digest of the source code of the package `symbolic`.

    It is computed once per process, so a later change of the files has no effect.

    Args:
        folder: folder of the cache of compiled libraries.
    """
    return Cache(folder).code_digest("symbolic")


@lru_cache(maxsize=CACHED_WORKCELLS)
def _parameters(workcell: Workcell) -> WorkcellParameters:
    from symbolic.parameters import WorkcellParameters

    return WorkcellParameters(workcell)


def bound_to(function: NumericFunction, numbers: WorkcellParameters) -> NumericFunction:
    """Return a function whose last inputs, the parameters, are filled in with the values of a cell.

    Start postures are not filled in: they remain inputs.

    Args:
        function: the function.
        numbers: parameters of the cell.
    """
    names = [name for name in function.input_names if name in numbers.sizes]
    return function.bound({name: numbers.vector(name) for name in names})


_held: dict[tuple[str, str, int], NumericFunction] = {}
"""Functions loaded by `contact_function`, which all cells of the same topology share, by name,
digest of the topology, and lanes."""


def contact_function(
    workcell: Workcell,
    name: str,
    make: Callable[[Workcell], ca.Function],
    lanes: int = 1,
) -> NumericFunction:
    """Return a compiled function of payload and contacts, with the parameters of a workcell filled
    in.

    The function is loaded from the cache if it was built before for a cell of the same topology.
    Arms and collision bodies are not read.

    Args:
        workcell: the cell.
        name: name of the function in the cache.
        make: function that makes the CasADi function from a workcell whose parameters are symbols.
        lanes: number of evaluations of a batch that run side by side; 0 for the machine's width.

    Raises:
        DualArmError: the code of the function cannot be built.
    """
    numbers = _parameters(workcell)
    of = (name, numbers.workcell_digest, lanes)
    if of not in _held:
        cache = Cache()
        key = key_of(
            name,
            structure=numbers.workcell_digest,
            expressions=_expressions(cache.folder),
            libraries=[f"scipy {library_version('scipy')}"],
        )
        built = load_or_build(key, lambda: {name: make(numbers.symbols())}, cache, lanes=lanes)
        _held[of] = built[name]
    return bound_to(_held[of], numbers)


EVALUATORS, SCREENING = "evaluators", "screening"
"""Names of the two sets of evaluators: functions that do not depend on collision bodies, and
functions that do."""

EVALUATOR_LANES = 0
"""Number of lanes of the evaluators; 0 for as many as suit the machine."""
