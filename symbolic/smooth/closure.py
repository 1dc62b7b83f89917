"""How an arm's joints follow the box: the inverse kinematics and its derivatives.

With the closure F(pose, q) = 0, zero where the joints hold the box at the pose, the joints follow
the pose by the implicit function, and a row c(pose, q) has the derivatives

    dq/dpose = -F_q^-1 F_pose,     nu = -F_q^-T c_q,     T = [I; dq/dpose],
    grad = T^T c_y,                Hessian = T^T (c_yy + sum_k nu_k F_k,yy) T,     y = (pose, q),

where pose stands for the extended pose and F for as many equations as there are joints: six hold
the box, one more ties each redundant joint to its value. They hold at a solution of F only: no
derivative is taken through Newton's steps, so the joints only need to be right, not differentiable.
CasADi's own implicit function (`rootfinder`) agrees, but takes three times as long for a Hessian.
"""

from __future__ import annotations

import casadi as ca

from symbolic.cell_model import CellModel
from symbolic.path.rotation import rotation_matrix
from symbolic.robot.arm import flange_target, newton_step, pose_error
from symbolic.smooth.keys import ClosureKey

SOLVE_STEPS = 5
"""Newton steps from the reference joints, which the solver renews in every round."""


def closure_functions(model: CellModel, arm: int) -> dict[ClosureKey, ca.Function]:
    """An arm's joints from a box pose, with what the derivatives of rows need.

    first: pose (6 + m,), q_reference (n,) -> q (n,) that hold the box; follow dq/dpose
        (n, 6 + m); pull -F_q^-1 (n, n), so that nu = pull^T c_q.
    second: pose, q, nu (n,) -> hessian (6 + m + n, 6 + m + n) of nu . F by (pose, q).
    """
    own = model.robots[arm]
    n = own.n_joints
    pose, nu = ca.SX.sym("pose", own.pose_size), ca.SX.sym("nu", n)
    reference = ca.SX.sym("q_reference", n)
    cell, rotation = model.workcell, rotation_matrix(own.orientation, pose[3:6])
    target = flange_target(cell.robots[arm], cell.contacts[arm], pose[:3], rotation)

    joints = ca.SX.sym("q", n)
    held = pose_error(*target, *own.placement(joints))[0]
    tied = [pose[place] - joints[joint] for joint, place in own.redundant]
    closure = ca.vertcat(held, *tied)
    pull = -ca.solve(ca.jacobian(closure, joints), ca.SX.eye(n))
    follow = ca.mtimes(pull, ca.jacobian(closure, pose))
    slopes = ca.Function("slopes", [pose, joints], [follow, pull])

    q = own.with_redundant(reference, pose)
    for _ in range(SOLVE_STEPS):
        q = newton_step(own, q, *target)
    first, second = ClosureKey(arm, "first"), ClosureKey(arm, "second")
    results = ca.cse([ca.densify(result) for result in (q, *slopes(pose, q))])
    curvature, _ = ca.hessian(ca.dot(nu, closure), ca.vertcat(pose, joints))
    return {
        first: ca.Function(
            first.name,
            [pose, reference],
            results,
            ["pose", "q_reference"],
            ["q", "follow", "pull"],
        ),
        second: ca.Function(
            second.name,
            [pose, joints, nu],
            ca.cse([ca.densify(curvature)]),
            ["pose", "q", "nu"],
            ["hessian"],
        ),
    }
