"""The geometry of a path at samples of its parameter, and between them."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from symbolic.array import Array

_SPLINE_EVERY = 2
"""Samples from one knot of the splines between them to the next."""


@dataclass(frozen=True)
class PathMotion:
    """Geometry of the path of a decision vector x (n_var,) at samples of the path parameter.

    Joints of both arms stand side by side. `symbolic.path_motion` describes the
    quantities.
    """

    x: Array
    parameter: Array
    pose: Array
    pose_first: Array
    pose_second: Array
    angular_first: Array
    angular_second: Array
    normal: Array
    force_by_acceleration: Array
    force_by_speed: Array
    q: Array
    q_first: Array
    q_second: Array
    torque_by_acceleration: Array
    torque_by_speed: Array
    torque_at_rest: Array
    wrench_torque: Array
    ik_residual: Array
    lost: Array
    limit_margin: Array
    manipulability: Array

    def at(self, samples: NDArray[np.intp]) -> PathMotion:
        """The given samples in the given order."""
        sampled = {f.name: getattr(self, f.name)[samples] for f in fields(self) if f.name != "x"}
        return PathMotion(self.x, **sampled)

    def between(self, u: Array) -> PathMotion:
        """The geometry at parameters u (n,) in [0, 1], by cubic splines through the samples."""
        spline, parts = self._spline
        values = np.split(spline(u), parts, axis=1)
        shaped = {
            name: value.reshape(len(u), *getattr(self, name).shape[1:])
            for name, value in zip(SAMPLED, values, strict=True)
        }
        return PathMotion(self.x, u, **shaped)

    def third(self, u: Array) -> tuple[Array, Array]:
        """Third derivatives by the parameter at u (n,): joints (n, joints), box position (n, 3)."""
        joints = self.q_second.shape[1]
        both = self._third(u)
        return both[:, :joints], both[:, joints : joints + 3]

    @cached_property
    def _spline(self) -> tuple[CubicSpline, Array]:
        """One spline through all quantities side by side, and where each but the first begins."""
        u = self.parameter[::_SPLINE_EVERY]
        columns = [getattr(self, name)[::_SPLINE_EVERY].reshape(len(u), -1) for name in SAMPLED]
        parts = np.cumsum([column.shape[1] for column in columns])[:-1]
        return CubicSpline(u, np.concatenate(columns, axis=1)), parts

    @cached_property
    def _third(self) -> CubicSpline:
        both = np.concatenate([self.q_second, self.pose_second], axis=1)
        return CubicSpline(self.parameter, both).derivative()


SAMPLED = tuple(f.name for f in fields(PathMotion) if f.name not in ("x", "parameter"))
