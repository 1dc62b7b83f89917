"""Normal forces of pads with any normals on their program's central path, with exact derivatives.

The least effort has kinks in the load, where a cone begins or ceases to be tight. With a weight mu
of the barriers, the states s of all patches, which are affine in the load w and in the free
components y, minimise

    f(y, w) = log effort(s) + mu * sum of the patches' barriers,    s = Y y + W w.

This is the central path of `symbolic.contact.central_path` with weight over effort equal to mu. The
solution is smooth, and homogeneous in the load like the least effort. The relative excess of its
effort over the least effort is at most mu times the patches' degrees; its normal forces C s tend to
those of least effort. By the implicit function theorem, with F = D^2 f and T = D^3 f, both by s,

    Y' F Y dy = -Y' F W dw,    U = ds/dw = Y dy/dw + W,    d(C s)/dw = C U,
    d^2(weight . C s)/dw^2 = U' T[d] U,    Y' F Y p = -Y' C' weight,    d = Y p.

Y' F Y is positive definite for every mu > 0, whether the least effort is unique or not.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from symbolic.contact.central_path import barrier_equations, centred, state_ends, wrenches_of
from symbolic.contact.force_closure import LOAD_SIZE, MOMENT_ARM
from symbolic.contact.grasp import SCALE_FLOOR, Grasp, full_wrench
from symbolic.expression import as_mx, mx_symbols

POLISH_STEPS = 2
"""Number of Newton steps on f from the iterate of the central path, which is within a tenth of a
per mille of the barriers' scale of its minimum."""

ROBOTS = 2


class SoftGrasp:
    """Convex program of a grasp's pads on its central path: nominal friction and a constant weight
    of the barriers. The last inputs of all its functions are the grasp's symbolic parameters.

    Attributes:
        grasp: program of the pads.
        weight: weight mu of the barriers over the effort.
        size: number of entries of the states of all patches together.
        ends: index at which each patch begins in these entries, then `size`.
        normals: matrix C (2, size) from the states to the normal forces of the robots.
    """

    def __init__(self, grasp: Grasp, weight: float) -> None:
        self.grasp, self.weight = grasp, weight
        self.ends = state_ends(grasp)
        self.size = self.ends[-1]
        normals = np.zeros((ROBOTS, self.size))
        normals[list(grasp.robots), self.ends[:-1]] = 1.0
        self.normals = ca.sparsify(ca.DM(normals))

    def first(self) -> ca.Function:
        """Build the function that solves the convex program for one load, and returns the normal
        forces with their derivatives.

        Input: load (6,), force and moment about the box frame's origin, along the box's axes [N, N
        m]. Outputs: normal (2,), normal forces of the robots [N]; slope (6, 2), their derivatives
        by the load; state (size,), the states (scaled wrenches) of all patches at the solution, an
        input of `second`.
        """
        load, groups = ca.MX.sym("load", LOAD_SIZE), mx_symbols(self.grasp.given)
        state = self.solve(load, groups)
        outputs = [*self.slopes()(state, *groups.values()), state]
        inputs, names = [load, *groups.values()], ["load", *groups]
        return ca.Function("held_first", inputs, outputs, names, ["normal", "slope", "state"])

    def solve(self, load: ca.MX, groups: dict[str, ca.MX]) -> ca.MX:
        """Build the expression of the states (size,) of all patches at the solution of the convex
        program: of all states that balance the load, those on the central path.

        Args:
            load: (6,) force and moment about the box frame's origin, along the box's axes [N, N m].
            groups: MX vectors of the grasp's parameters, by name of the parameter group.
        """
        given = list(groups.values())
        friction = as_mx(self.grasp.friction, self.grasp.given, groups)
        scale = ca.sqrt(ca.sumsqr(load[:3]) + ca.sumsqr(load[3:] / MOMENT_ARM) + SCALE_FLOOR**2)
        state = scale * centred(self.grasp, self.weight)(load / scale, friction, *given)
        step = self._newton()
        for _ in range(POLISH_STEPS):
            state = step(state, *given)
        return state

    def wrenches(self, slopes: bool) -> ca.Function:
        """Build the function from the states (size,) of all patches to the wrenches (6 k,) of the k
        pads.

        A wrench holds, along the pad's axes, normal force and tangential force (2,) [N], the normal
        force times the shift (2,) of the centre of pressure, and torsion [N m].

        Args:
            slopes: True for a second output, the derivatives (6 k, 6) of the wrenches by the load.
        """
        state = ca.SX.sym("state", self.size)
        own = wrenches_of(self.grasp, ca.vertsplit(state, self.ends))
        units = [self.grasp.units(i, self.grasp.friction) * wrench for i, wrench in enumerate(own)]
        outputs = [ca.vertcat(*map(full_wrench, units))]
        if slopes:
            by_state = ca.jacobian(outputs[0], state)
            outputs.append(ca.mtimes(by_state, _Local(self, state).by_load()))
        results = ca.cse([ca.densify(value) for value in outputs])
        return ca.Function("held_wrenches", [state, *self.grasp.given.values()], results)

    def second(self) -> ca.Function:
        """Build the function of the second derivatives of the robots' normal forces by the load.

        Inputs: state (size,) of all patches; weight (2,), a factor on each robot's normal force.
        Output: curvature (6, 6), the Hessian of the weighted sum of the normal forces.
        """
        state, weight = ca.SX.sym("state", self.size), ca.SX.sym("weight", ROBOTS)
        local = _Local(self, state)
        along = local.solve(-ca.mtimes(self.normals.T, weight))
        curvature = local.third(along, local.by_load())
        return ca.Function(
            "held_second",
            [state, weight, *self.grasp.given.values()],
            [ca.cse(ca.densify(curvature))],
            ["state", "weight", *self.grasp.given],
            ["curvature"],
        )

    def slopes(self) -> ca.Function:
        """Build the function that computes the normal forces of the robots at a solution of the
        convex program, and their derivatives.

        Input: the states (size,) of all patches. Outputs: normal forces (2,) [N]; and their
        derivatives (6, 2) by the load.
        """
        state = ca.SX.sym("state", self.size)
        by_load = _Local(self, state).by_load()
        outputs = [ca.mtimes(self.normals, state), ca.mtimes(self.normals, by_load).T]
        inputs = [state, *self.grasp.given.values()]
        return ca.Function("slopes", inputs, ca.cse([ca.densify(value) for value in outputs]))

    def _newton(self) -> ca.Function:
        """Build the function of one Newton step on the module's objective f, at a constant load:
        from the states (size,) of all patches to states nearer the minimum."""
        state = ca.SX.sym("state", self.size)
        local = _Local(self, state)
        inputs = [state, *self.grasp.given.values()]
        return ca.Function("newton", inputs, [ca.cse(state + local.solve(-local.slope))])


class _Local:
    """Derivatives of the objective f(y, w) of the module at given states (n,) of all patches.

    f is log effort plus the weighted barriers of the patches; y are the free components, w the
    load, and Y is the derivative of the states by y. The curvature of log effort, Q / effort - g
    g', has a rank-one part, which is treated separately.

    Attributes:
        slope: gradient (n,) of f by the states: the gradient g of log effort plus the gradients of
            the barriers.
    """

    def __init__(self, program: SoftGrasp, state: ca.SX) -> None:
        self._program, grasp = program, program.grasp
        self._owns, load = ca.vertsplit(state, program.ends), ca.SX.sym("load", LOAD_SIZE)
        _, pulls, equations = barrier_equations(
            grasp, self._owns, [load, grasp.friction], program.weight
        )
        self._equations, self._effort = equations, equations.effort
        self._g, self._square = equations.slope / self._effort, equations.curvature
        self.slope = self._g - ca.vertcat(*pulls) / self._effort
        self._loaded = ca.jacobian(equations.missing, load)
        # The equations are those of f times the effort, without g g'.
        self._answer = self._effort * equations.balanced_change(self._g)
        self._share = 1.0 / (1.0 - ca.dot(self._g, self._answer))

    def solve(self, pull: ca.SX) -> ca.SX:
        """Compute the direction (n,) Y y of the states that solves Newton's equations Y' F Y y = Y'
        pull of the module. A step along it keeps the load balanced.

        y is the change of the free components of the states, and Y (n, free_size) the derivative of
        the states by these components. F is the Hessian (n, n) of the objective f (log effort plus
        weighted barriers) by the states.

        Args:
            pull: (n,) right side, one entry per entry of the states.
        """
        return self._with_g(self._effort * self._equations.balanced_change(pull))

    def by_load(self) -> ca.SX:
        """Compute the derivatives (n, 6) of the states by the load."""
        return self._with_g(self._equations.constrained(self._loaded))

    def _with_g(self, found: ca.SX) -> ca.SX:
        """Add the effect of the rank-one part -g g' of the Hessian to solutions of Newton's
        equations without this part, by the Sherman-Morrison formula. g (n,) is the gradient of log
        effort.

        Args:
            found: (n, k) solutions without the rank-one part.

        Returns:
            (n, k) solutions with this part.
        """
        return found + ca.mtimes(self._answer, self._share * ca.mtimes(self._g.T, found))

    def third(self, along: ca.SX, by_load: ca.SX) -> ca.SX:
        """Compute the matrix U' T[d] U (6, 6), from which second derivatives of the normal forces
        by the load follow. T[d] is the derivative along d of the Hessian of the objective f (log
        effort plus weighted barriers) by the states.

        Args:
            along: (n,) direction d of the states.
            by_load: (n, 6) derivatives U of the states by the load.
        """
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
