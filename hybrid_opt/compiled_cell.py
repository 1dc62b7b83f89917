"""A workcell's compiled functions, all made from one symbolic model."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property
from importlib.metadata import version
from typing import TYPE_CHECKING

from codegen.build import load_or_build
from codegen.cache import Cache, key_of
from codegen.compiler import find_compiler
from codegen.function import NumericFunction
from symbolic.records import Workcell

if TYPE_CHECKING:
    import casadi as ca

    from symbolic.cell_model import CellBodies, CellModel


class CompiledCell:
    """What is compiled for a workcell. Share one wherever several sets of functions are needed.

    A set is loaded where it was built before, also by other processes; then neither expressions
    nor the model are made. Otherwise it is made from the model, which is built once.

    Attributes:
        workcell: the description.
        cache: where libraries are kept, None for the user's folder.
    """

    def __init__(
        self, workcell: Workcell, cache: Cache | None = None, model: CellModel | None = None
    ) -> None:
        """Nothing is built yet.

        Args:
            model: the cell's symbolic model where it does not follow from the workcell alone, such
                as with other start postures than the stated criterion's.

        Raises:
            CodegenError: there is no C compiler.
        """
        find_compiler()
        self.workcell = workcell
        self.cache = cache
        self._given = model

    @classmethod
    def of(cls, cell: Workcell | CompiledCell) -> CompiledCell:
        """A workcell to be compiled; one that is compiled already is shared."""
        return cell if isinstance(cell, CompiledCell) else cls(cell)

    @cached_property
    def model(self) -> CellModel:
        """The symbolic model.

        Raises:
            DualArmError: it cannot be built.
        """
        # Not imported at the top: a warm start needs neither CasADi nor Pinocchio.
        from symbolic.cell_model import build_cell_model

        return build_cell_model(self.workcell) if self._given is None else self._given

    @cached_property
    def bodies(self) -> CellBodies:
        """Arms and bodies: the model where it is known, else without start postures.

        Raises:
            DualArmError: they cannot be read.
        """
        known: CellBodies | None = vars(self).get("model", self._given)
        if known is not None:
            return known
        from symbolic.cell_model import build_cell_bodies

        return build_cell_bodies(self.workcell)

    @cached_property
    def _expressions(self) -> str:
        return (self.cache or Cache()).code_digest("symbolic")

    @property
    def is_identified(self) -> bool:
        """Whether the workcell's files say what is compiled; otherwise only its own text does."""
        return bool(self.workcell.digest) and self._given is None

    def key(self, name: str, *details: str) -> str | None:
        """A recipe's key: what a set of functions is made from (CasADi is part of every set's).
        None where the cell is not identified."""
        if not self.is_identified:
            return None
        return key_of(
            name,
            workcell=self.workcell.digest,
            expressions=self._expressions,
            libraries=[f"{library} {version(library)}" for library in ("pin", "scipy")],
            details=details,
        )

    def functions(
        self,
        name: str,
        make: Callable[[CellModel], Mapping[str, ca.Function]],
        *details: str,
        lanes: int = 1,
        levels: Mapping[str, int] | None = None,
    ) -> dict[str, NumericFunction]:
        """A set of functions, from the cache where it was built before.

        Args:
            name: of the set.
            make: makes the functions from the model.
            details: whatever else `make` depends on.
            lanes, levels: see `codegen.build.build`.

        Raises:
            DualArmError: the model or its code cannot be built.
        """
        return self.made(name, lambda: make(self.model), *details, lanes=lanes, levels=levels)

    def made(
        self,
        name: str,
        make: Callable[[], Mapping[str, ca.Function]],
        *details: str,
        lanes: int = 1,
        levels: Mapping[str, int] | None = None,
    ) -> dict[str, NumericFunction]:
        """As `functions`, for what is made of less than the whole model.

        Raises:
            DualArmError: the code cannot be built.
        """
        return load_or_build(self.key(name, *details), make, self.cache, lanes=lanes, levels=levels)

    @cached_property
    def evaluators(self) -> dict[str, NumericFunction]:
        """Every function of `symbolic.functions.cell_functions`."""

        def make(model: CellModel) -> Mapping[str, ca.Function]:
            from symbolic.functions import cell_functions

            return cell_functions(model)

        return self.functions(EVALUATORS, make, lanes=EVALUATOR_LANES)


EVALUATORS = "evaluators"
"""Name of the set of a cell's evaluators."""

EVALUATOR_LANES = 0
"""As many as suit the machine."""
