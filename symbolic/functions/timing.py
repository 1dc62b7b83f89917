"""The CasADi functions that timing a carry needs, by name."""

from __future__ import annotations

import casadi as ca

from symbolic.cell_model import CellModel
from symbolic.physics.path_motion import arm_derivative_function, path_motion_function
from symbolic.physics.payload_load import load_function, uncertain_load_function


def timing_functions(model: CellModel, samples: int) -> dict[str, ca.Function]:
    """Functions for the timing of one workcell.

    path_motion: see `symbolic.physics.path_motion`, at that many samples. load, uncertain_load: see
    `symbolic.physics.payload_load`. arm_i per arm i = 1, 2: see
    `symbolic.physics.path_motion.arm_derivative_function`.
    """
    workcell = model.workcell
    functions = {
        "path_motion": path_motion_function(model, samples),
        "load": load_function(workcell),
        "uncertain_load": uncertain_load_function(workcell),
    }
    for i, (robot, robot_model, contact) in enumerate(
        zip(workcell.robots, model.robots, workcell.contacts, strict=True), start=1
    ):
        functions[f"arm_{i}"] = arm_derivative_function(robot, robot_model, contact, f"arm_{i}")
    return functions
