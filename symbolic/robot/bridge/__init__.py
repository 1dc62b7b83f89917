"""Pinocchio's algorithms as CasADi functions, through this project's own C++ extension.

The extension `_pinocchio_casadi` instantiates Pinocchio's algorithms over `casadi::SX`. It is used
even where a `pinocchio.casadi` module exists, so that a robot gives the same expressions on every
machine. Model and function pass between Python and C++ as text (`pinocchio.Model` and
`casadi.Function` both serialise), so the extension needs no Python bindings of either library.

Every function here takes a numeric `pinocchio.Model` and returns a `casadi.Function` over SX
with dense outputs, which may be called on SX, MX and DM. nq and nv are the model's numbers of joint
positions and velocities. Frames: "root" is the model's universe frame, the URDF's root link.

Raises:
    BridgeError: the extension is missing, cannot be loaded, or was built for other versions.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import casadi
import pinocchio

from symbolic.extension import compiled_module, require_same_minor


def frame_kinematics(model: pinocchio.Model, frame: int) -> casadi.Function:
    """Build the function from q (nq,) to placement and Jacobian of a frame of the model.

    Outputs: rotation (3, 3) and position (3,) [m] of the frame in the root, and jacobian (6, nv).
    Rows 0-2 of the Jacobian give the linear velocity of the frame's origin, rows 3-5 the angular
    velocity, both along the root's axes (Pinocchio's LOCAL_WORLD_ALIGNED).

    Args:
        model: the robot's model.
        frame: index of the frame among the model's frames.
    """
    return _function(_extension().frame_kinematics(model.saveToString(), frame))


def frame_drift(model: pinocchio.Model, frame: int) -> casadi.Function:
    """Build the function from q (nq,) and v (nv,) to a frame's acceleration dJ/dt v.

    This is the part (6,) of the acceleration that joint velocities alone cause: linear [m/s^2],
    then angular [rad/s^2], along the root's axes. The frame's classical acceleration is jacobian @
    a + drift, with the joint accelerations a.

    Args:
        model: the robot's model.
        frame: index of the frame among the model's frames.
    """
    return _function(_extension().frame_drift(model.saveToString(), frame))


def joint_placements(model: pinocchio.Model) -> casadi.Function:
    """Build the function from q (nq,) to the placements of the model's n joints in the root.

    Outputs: rotations (3, 3 n), side by side, and positions (3, n) [m], in the order of the model;
    Pinocchio's "universe" is left out.
    """
    return _function(_extension().joint_placements(model.saveToString()))


def inverse_dynamics(model: pinocchio.Model) -> casadi.Function:
    """Build the function from q (nq,), v (nv,) and a (nv,) to joint torques (nv,) [N m], or forces
    of sliding joints [N].

    The recursive Newton-Euler algorithm includes the model's gravity and rotor inertias; there are
    no external forces.
    """
    return _function(_extension().inverse_dynamics(model.saveToString()))


@cache
def _extension() -> Any:
    """Import the compiled module, after casadi and pinocchio have loaded its libraries."""
    name = "symbolic.robot.bridge._pinocchio_casadi"
    extension = compiled_module(name, "the Pinocchio-CasADi bridge")
    require_same_minor(
        {"pinocchio": extension.PINOCCHIO_VERSION, "casadi": extension.CASADI_VERSION},
        {"pinocchio": pinocchio.__version__, "casadi": casadi.CasadiMeta.version()},
    )
    return extension


def _function(serialised: str) -> casadi.Function:
    """Restore a serialised function, sharing terms that Pinocchio's algorithms compute twice."""
    function = casadi.Function.deserialize(serialised)
    inputs = function.sx_in()
    outputs = casadi.cse(function.call(inputs))
    return casadi.Function(
        function.name(), inputs, outputs, function.name_in(), function.name_out()
    )
