"""Forces that single cases ask for, compiled: for two facing round pads, and for pads anywhere."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from codegen.build import compile_function
from codegen.cache import Cache
from codegen.function import NumericFunction
from symbolic.array import Array
from symbolic.contact.worst_cases import (
    GraspSqueeze,
    case_grasp_function,
    case_grasp_slack_function,
    case_slack_function,
    case_squeeze_function,
)
from symbolic.errors import SettingsError
from symbolic.read.checks import PATCH_OVERLAP, pads_beside
from symbolic.records import Workcell


class CaseForces:
    """Least forces that hold single cases.

    Attributes:
        workcell: the cell.
    """

    def __init__(self, workcell: Workcell, cache: Cache | None = None) -> None:
        """Load or build the functions of facing pads; those of others when first asked.

        Raises:
            SettingsError: some cases cannot be held, however hard the pads press.
            DualArmError: a function cannot be built.
        """
        check_pads(workcell)
        self.workcell, self._cache = workcell, cache
        self._general: dict[int, tuple[NumericFunction, NumericFunction]] = {}
        self._squeezed = is_squeezed(workcell)
        if self._squeezed:
            self._facing = [
                compile_function(function(workcell), cache, lanes=0)
                for function in (case_squeeze_function, case_slack_function)
            ]

    def least(
        self, motion: tuple[Array, ...], cases: Array, leader: int, threads: int = 1
    ) -> Array:
        """(m, 2) least normal forces [N]: what is to be commanded of one robot, and what the
        leading one then presses with.

        Args:
            motion: poses and their time derivatives (m, 6) each.
            cases: (m, 15).
            leader: index of the robot whose force is not commanded.
            threads: 0 for one per core.
        """
        function = self._functions(1 - leader)[0]
        return function.batch(*motion, cases, threads=threads)["normal_force"]

    def surely_held(
        self,
        motion: tuple[Array, ...],
        cases: Array,
        force: Array,
        leader: int,
        threads: int = 1,
    ) -> NDArray[np.bool_]:
        """(m,) whether a pressure that is known beforehand holds under commanded forces (m,) [N];
        where not, another one still may."""
        slack = self._functions(1 - leader)[1]
        arm = (float(1 - leader),) if self._squeezed else ()
        found = slack.batch(*motion, cases, force, *arm, threads=threads)["slack"]
        return np.asarray(found.ravel() > 0.0, dtype=np.bool_)

    def leading_share(self, leader: int) -> float:
        """Rise of the leading robot's force per newton of the commanded one."""
        if self._squeezed:
            return 1.0
        normals = self._squeeze_normals
        return float(normals[leader] / normals[1 - leader])

    @cached_property
    def _squeeze_normals(self) -> Array:
        return GraspSqueeze(self.workcell, 1).squeeze_normals()

    def _functions(self, commanded: int) -> tuple[NumericFunction, NumericFunction]:
        if self._squeezed:
            return self._facing[0], self._facing[1]
        if commanded not in self._general:
            first, second = (
                compile_function(function(self.workcell, commanded), self._cache, lanes=0)
                for function in (case_grasp_function, case_grasp_slack_function)
            )
            self._general[commanded] = first, second
        return self._general[commanded]


def is_squeezed(workcell: Workcell) -> bool:
    """Whether the force of one pad decides that of the other, so that a least squeeze says all."""
    soft = workcell.task.allocation == "soft-finger"
    return workcell.has_facing_pads or (soft and workcell.has_opposite_pads)


def check_pads(workcell: Workcell) -> None:
    """Refuse pads that cannot hold whatever happens.

    Raises:
        SettingsError: some cases cannot be held, however hard both press.
    """
    if not workcell.has_facing_pads:
        return  # a grasp that is not closed is refused where its squeeze is looked for
    room = PATCH_OVERLAP * sum(contact.patch_radius for contact in workcell.contacts)
    if pads_beside(workcell) >= room:
        raise SettingsError(
            f"the contacts lie {pads_beside(workcell):g} m beside one another; robust forces "
            f"need less than {room:g} m, so that pressing harder holds whatever happens"
        )
