"""Normal forces of pads anywhere on their program's central path, with exact derivatives.

The least effort has kinks in the load, where a cone begins or ceases to be tight. At a weight mu of
the barriers the states s of all patches, affine in the load w and in what is free, y, minimise

    f(y, w) = log effort(s) + mu * sum of the patches' barriers,    s = Y y + W w,

which is the central path of `symbolic.contact.central_path`: weight over effort is mu. It is smooth
and as homogeneous in the load as the least effort itself, above which its own lies by at most mu
times the patches' degrees, relatively; the normal forces C s tend to those of least effort. By the
implicit function theorem, with F = D^2 f and T = D^3 f, both by s,

    Y' F Y dy = -Y' F W dw,    U = ds/dw = Y dy/dw + W,    d(C s)/dw = C U,
    d^2(weight . C s)/dw^2 = U' T[d] U,    Y' F Y p = -Y' C' weight,    d = Y p.

Y' F Y is positive definite for every mu > 0, whether the least effort is unique or not.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from symbolic.contact.central_path import against_barriers, centred, state_ends, wrenches_of
from symbolic.contact.force_closure import LOAD_SIZE, MOMENT_ARM
from symbolic.contact.grasp import SCALE_FLOOR, Grasp, whole_wrench
from symbolic.expression import as_mx, mx_symbols

POLISH_STEPS = 2
"""Newton steps of f itself, from the central path's iterate, which lies a tenth of a per mille of
the barriers' scale from its minimum or nearer."""

ROBOTS = 2


class SoftGrasp:
    """The program of a grasp's pads at their own friction, at one weight. Its functions take the
    grasp's given numbers last.

    Attributes:
        grasp: the pads.
        weight: mu.
        size, ends: of the states of all patches together, and where each begins.
        normals: C (2, size).
    """

    def __init__(self, grasp: Grasp, weight: float) -> None:
        self.grasp, self.weight = grasp, weight
        self.ends = state_ends(grasp)
        self.size = self.ends[-1]
        normals = np.zeros((ROBOTS, self.size))
        normals[list(grasp.robots), self.ends[:-1]] = 1.0
        self.normals = ca.sparsify(ca.DM(normals))

    def first(self) -> ca.Function:
        """load (6,), see `symbolic.contact.grasp.grasp_wrenches`, to normal (2,) forces of the
        robots [N], slope (6, 2), their gradients, and state (size,)."""
        load, handed = ca.MX.sym("load", LOAD_SIZE), mx_symbols(self.grasp.given)
        state = self.solved(load, handed)
        outputs = [*self.slopes()(state, *handed.values()), state]
        inputs, names = [load, *handed.values()], ["load", *handed]
        return ca.Function("held_first", inputs, outputs, names, ["normal", "slope", "state"])

    def solved(self, load: ca.MX, handed: dict[str, ca.MX]) -> ca.MX:
        """The state (size,) that holds a load (6,).

        Args:
            handed: the given numbers.
        """
        given = list(handed.values())
        friction = as_mx(self.grasp.friction, self.grasp.given, handed)
        scale = ca.sqrt(ca.sumsqr(load[:3]) + ca.sumsqr(load[3:] / MOMENT_ARM) + SCALE_FLOOR**2)
        state = scale * centred(self.grasp, self.weight)(load / scale, friction, *given)
        step = self._newton()
        for _ in range(POLISH_STEPS):
            state = step(state, *given)
        return state

    def wrenches(self, slopes: bool) -> ca.Function:
        """state (size,) to wrenches (6 k,) of all pads, see
        `symbolic.contact.grasp.grasp_wrenches`, and where asked for, to by_load (6 k, 6)."""
        state = ca.SX.sym("state", self.size)
        own = wrenches_of(self.grasp, ca.vertsplit(state, self.ends))
        units = [self.grasp.units(i, self.grasp.friction) * wrench for i, wrench in enumerate(own)]
        outputs = [ca.vertcat(*map(whole_wrench, units))]
        if slopes:
            by_state = ca.jacobian(outputs[0], state)
            outputs.append(ca.mtimes(by_state, _Local(self, state).by_load()))
        results = ca.cse([ca.densify(value) for value in outputs])
        return ca.Function("held_wrenches", [state, *self.grasp.given.values()], results)

    def second(self) -> ca.Function:
        """state (size,) and weight (2,) to curvature (6, 6), the weighted second derivatives of the
        normal forces by the load."""
        state, weight = ca.SX.sym("state", self.size), ca.SX.sym("weight", ROBOTS)
        local = _Local(self, state)
        along = local.pulled(-ca.mtimes(self.normals.T, weight))
        curvature = local.third(along, local.by_load())
        return ca.Function(
            "held_second",
            [state, weight, *self.grasp.given.values()],
            [ca.cse(ca.densify(curvature))],
            ["state", "weight", *self.grasp.given],
            ["curvature"],
        )

    def slopes(self) -> ca.Function:
        """A state to both normal forces and their gradients by the load (6, 2)."""
        state = ca.SX.sym("state", self.size)
        by_load = _Local(self, state).by_load()
        outputs = [ca.mtimes(self.normals, state), ca.mtimes(self.normals, by_load).T]
        inputs = [state, *self.grasp.given.values()]
        return ca.Function("slopes", inputs, ca.cse([ca.densify(value) for value in outputs]))

    def _newton(self) -> ca.Function:
        """A state to the next one, under the same load."""
        state = ca.SX.sym("state", self.size)
        local = _Local(self, state)
        inputs = [state, *self.grasp.given.values()]
        return ca.Function("newton", inputs, [ca.cse(state + local.pulled(-local.slope))])


class _Local:
    """Derivatives of f at a state: those of the barriers, patch by patch, and those of log effort,
    whose curvature Q / effort - g g' is of rank one beside a diagonal.

    Attributes:
        slope: g plus the barriers' (n,).
    """

    def __init__(self, program: SoftGrasp, state: ca.SX) -> None:
        self._program, grasp = program, program.grasp
        self._owns, load = ca.vertsplit(state, program.ends), ca.SX.sym("load", LOAD_SIZE)
        _, pulls, equations = against_barriers(
            grasp, self._owns, [load, grasp.friction], program.weight
        )
        self._equations, self._effort = equations, equations.effort
        self._g, self._square = equations.slope / self._effort, equations.curvature
        self.slope = self._g - ca.vertcat(*pulls) / self._effort
        self._loaded = ca.jacobian(equations.missing, load)
        # The equations are those of f times the effort, without g g'.
        self._answer = self._effort * equations.pulled(self._g)
        self._share = 1.0 / (1.0 - ca.dot(self._g, self._answer))

    def pulled(self, pull: ca.SX) -> ca.SX:
        """Y y (n,) of Y' F Y y = Y' pull."""
        return self._with_g(self._effort * self._equations.pulled(pull))

    def by_load(self) -> ca.SX:
        """U (n, 6)."""
        return self._with_g(self._equations.settled(self._loaded))

    def _with_g(self, found: ca.SX) -> ca.SX:
        """From what holds without g g' (n, k), by Sherman and Morrison's formula."""
        return found + ca.mtimes(self._answer, self._share * ca.mtimes(self._g.T, found))

    def third(self, along: ca.SX, by_load: ca.SX) -> ca.SX:
        """U' T[d] U for a direction d (n,)."""
        rows = zip(
            self._program.grasp.patches,
            self._owns,
            ca.vertsplit(along, self._program.ends),
            ca.vertsplit(by_load, self._program.ends),
            strict=True,
        )
        barriers = sum(ca.mtimes(u.T, patch.third(own, d, u)) for patch, own, d, u in rows)
        # Derivatives of log effort.
        over = 1.0 / self._effort
        turned = ca.mtimes(self._square, along)
        by, bent = (ca.mtimes(by_load.T, v) for v in (self._g, turned))
        size, both = ca.dot(self._g, along), ca.mtimes(by, bent.T)
        square = ca.mtimes([by_load.T, self._square, by_load])
        of_effort = 2.0 * size * ca.mtimes(by, by.T) - over * (size * square + both + both.T)
        return self._program.weight * barriers + of_effort
