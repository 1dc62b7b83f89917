"""Pinocchio's algorithms as CasADi functions, through this project's own C++ extension.

The extension `_pinocchio_casadi` instantiates Pinocchio's algorithms over `casadi::SX`. It is
used even where a `pinocchio.casadi` module exists, so that a robot gives the same expressions on
every machine. Model and function cross the language border as text (`pinocchio.Model` and
`casadi.Function` both serialise), so neither side depends on the other's Python bindings.

Every function here takes a numeric `pinocchio.Model` and returns a `casadi.Function` over SX with
dense outputs, which may be called on SX, MX and DM. nq and nv are the model's configuration and
tangent dimensions. Frames: "root" is the model's universe frame, the URDF's root link.

Raises:
    BridgeError: the extension is missing, cannot be loaded, or was built for other versions.
"""

from __future__ import annotations

from functools import cache
from importlib import import_module
from typing import Any

import casadi
import pinocchio

from symbolic.errors import BridgeError

REMEDY = "run `pip install -e .` in the project's folder to compile it for this environment"


def frame_kinematics(model: pinocchio.Model, frame: int) -> casadi.Function:
    """Return the placement and Jacobian of a frame of the model.

    q (nq,) -> rotation (3, 3) and position (3,) [m] of the frame in the root, and its jacobian
    (6, nv): rows 0-2 give the linear velocity of the frame's origin, rows 3-5 the angular
    velocity, both along the root's axes (Pinocchio's LOCAL_WORLD_ALIGNED).
    """
    return _function(_extension().frame_kinematics(model.saveToString(), frame))


def frame_drift(model: pinocchio.Model, frame: int) -> casadi.Function:
    """Build the function of the part dJ/dt v of a frame's acceleration, which the joint velocities
    alone cause.

    q (nq,), v (nv,) -> drift (6,): linear [m/s^2] then angular [rad/s^2], along the root's axes.
    The frame's classical acceleration is jacobian @ a + drift.
    """
    return _function(_extension().frame_drift(model.saveToString(), frame))


def joint_placements(model: pinocchio.Model) -> casadi.Function:
    """Return the placements of all n joints but the universe, in the model's order.

    q (nq,) -> rotations (3, 3 n), side by side, and positions (3, n) [m], in the root.
    """
    return _function(_extension().joint_placements(model.saveToString()))


def inverse_dynamics(model: pinocchio.Model) -> casadi.Function:
    """Return joint torques without external forces, by the recursive Newton-Euler algorithm.

    q (nq,), v (nv,), a (nv,) -> torque (nv,) [N m]; gravity is the model's, rotor inertias count.
    """
    return _function(_extension().inverse_dynamics(model.saveToString()))


def require_same_minor(built: dict[str, str], installed: dict[str, str]) -> None:
    """Check that versions agree in major and minor number.

    Args:
        built, installed: versions by library name.

    Raises:
        BridgeError: versions differ; the message names every such library.
    """
    different = [
        f"{library} {installed[library]} is installed, {version} was compiled against"
        for library, version in built.items()
        if installed[library].split(".")[:2] != version.split(".")[:2]
    ]
    if different:
        raise BridgeError(
            f"the compiled modules do not fit: {'; '.join(different)}; {REMEDY}", code="versions"
        )


def compiled_module(name: str, part: str) -> Any:
    """Import one of the project's compiled modules.

    Args:
        name: name of the module; the libraries that it links to have been loaded already.
        part: name of the module for people, as in 'the compiled part of the polish'.

    Raises:
        BridgeError: the module is missing or cannot be loaded.
    """
    try:
        return import_module(name)
    except ImportError as error:
        raise BridgeError(
            f"{part} cannot be loaded ({error}); {REMEDY}", code="not-loadable"
        ) from error


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
