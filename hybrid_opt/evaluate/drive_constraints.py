"""Why a path cannot be driven, beside what the samples of a candidate show."""

FORCE_LIMIT = "force_limit"
JOINT_TORQUE = "joint_torque"
NO_TIMING = "no_timing"
DRIVE_CONSTRAINTS = (FORCE_LIMIT, JOINT_TORQUE, NO_TIMING)
"""Names of the time law 'optimal'.

force_limit, joint_torque: standing still needs more; violation: its share of the limit, minus 1.
no_timing: the solver of timings fails the path for any other reason; violation: 1.
"""
