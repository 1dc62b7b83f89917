"""Two synchronised RAPID tasks (ABB MultiMove) that drive a trajectory. docs/export.md has limits.

Syntax after ABB's technical reference manual for RAPID instructions (MoveAbsJ, SyncMoveOn,
SyncMoveOff) and the MultiMove application manual: every move between SyncMoveOn and SyncMoveOff
carries an ID, the same in both tasks, ascending.
"""

from __future__ import annotations

import numpy as np

from hybrid_opt.carry import Carry
from symbolic.errors import SettingsError

TASKS = ("T_ROB1", "T_ROB2")
MAX_MOVES = 2000
"""A module beyond this many moves is refused: controllers load them slowly or not at all."""

LEAST_MOVE_TIME = 0.02
"""Shortest time of one move [s]: below it a controller cannot plan ahead."""

AXES = 6
"""Robot axes of a jointtarget."""

APPROACH_SPEED = "v50"
ZONE = "z1"
_LINE_LENGTH = 60


def rapid_modules(carry: Carry) -> tuple[str, str]:
    """The modules of both tasks.

    Raises:
        SettingsError: an arm has more than six joints, the time step is too short or the
            trajectory too long for RAPID.
    """
    for robot, arm in zip(carry.workcell.robots, carry.arms, strict=True):
        if arm.q.shape[1] != AXES:
            raise SettingsError(
                f"robot {robot.name!r} has {arm.q.shape[1]} joints; RAPID's jointtarget holds "
                f"{AXES} robot axes, choose another format"
            )
    moves = len(carry.time) - 1
    step = float(carry.time[1])
    if step < LEAST_MOVE_TIME or moves > MAX_MOVES:
        raise SettingsError(
            f"{moves} moves of {step:g} s are too many or too short for RAPID; choose a time "
            f"step of at least {LEAST_MOVE_TIME:g} s that gives at most {MAX_MOVES} moves"
        )
    return _module(carry, 0), _module(carry, 1)


def _module(carry: Carry, arm: int) -> str:
    degrees = np.rad2deg(carry.arms[arm].q)
    lines = [
        f"MODULE Carry{arm + 1}",
        f"  ! {_comment(carry.workcell.name)}",
        f"  ! Robot {_comment(carry.workcell.robots[arm].name)} in task {TASKS[arm]}",
        f"  ! {len(carry.time)} positions, {float(carry.time[-1]):.3f} s",
        f'  PERS tasks carryTasks{{2}} := [["{TASKS[0]}"],["{TASKS[1]}"]];',
        "  VAR syncident carryStart;",
        "  VAR syncident carryEnd;",
        "",
        "  PROC Carry()",
        f"    MoveAbsJ {_target(degrees[0])} \\NoEOffs, {APPROACH_SPEED}, fine, tool0;",
        "    SyncMoveOn carryStart, carryTasks;",
    ]
    for k in range(1, len(degrees)):
        time = float(carry.time[k] - carry.time[k - 1])
        zone = ZONE if k < len(degrees) - 1 else "fine"
        lines.append(
            f"    MoveAbsJ {_target(degrees[k])} \\ID:={10 * k} \\NoEOffs, "
            f"v1000 \\T:={time:.6f}, {zone}, tool0;"
        )
    lines += ["    SyncMoveOff carryEnd;", "  ENDPROC", "ENDMODULE", ""]
    # RAPID files have Windows line ends.
    return "\r\n".join(lines)


def _target(degrees: np.ndarray) -> str:
    """A jointtarget without external axes."""
    robot = ",".join(f"{value:.6f}" for value in degrees)
    return f"[[{robot}],[9E9,9E9,9E9,9E9,9E9,9E9]]"


def _comment(text: str) -> str:
    """Text that cannot end or leave a RAPID comment line."""
    return "".join(c if " " <= c <= "~" else "?" for c in text)[:_LINE_LENGTH]
