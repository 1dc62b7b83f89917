"""All CasADi functions of a workcell that are worth compiling."""

from __future__ import annotations

import casadi as ca

from symbolic.cell_model import CellModel
from symbolic.functions.candidate import candidate_function, sample_functions
from symbolic.robot.arm import posture_function


def cell_functions(model: CellModel) -> dict[str, ca.Function]:
    """The functions by name.

    candidate: the evaluator of a whole candidate (`symbolic.functions.candidate`).
    inverse_dynamics_i: of each arm i = 1, 2 (`symbolic.robot.model`).
    posture: both arms at one box pose (`symbolic.robot.arm.posture_function`).
    clearance, piece_poses, motion: collision bounds, placements and bounds of the motion
    (`symbolic.geometry.clearance.screening_functions`).
    """
    return {
        "candidate": candidate_function(model),
        **{f"inverse_dynamics_{i + 1}": model.robots[i].inverse_dynamics for i in (0, 1)},
        "posture": posture_function(model.workcell.robots, model.robots, model.workcell.contacts),
        **model.screening,
    }


def kernel_functions(model: CellModel) -> dict[str, ca.Function]:
    """What a whole evaluation is put together from, sample by sample.

    path, begin, start, predict, sample and, of some cells, forces: see
    `symbolic.functions.candidate.sample_functions`.
    clearance, piece_poses: see `symbolic.geometry.clearance.screening_functions`.
    """
    screening = {name: model.screening[name] for name in ("clearance", "piece_poses")}
    return sample_functions(model) | screening
