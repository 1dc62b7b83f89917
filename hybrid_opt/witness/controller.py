"""Controllers as a cell has them: joint impedance, and force control along the contact normal.

All feed the planned torques forward. `impedance`: every joint is a spring and a damper about its
reference. `leader`: so is the leading arm; the other has no stiffness along the normal and an
integral control of its normal force instead. `both`: both are so, with the mean of their force
errors and a weak spring along the normal each, since nothing else keeps the box in its place
between them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from hybrid_opt.witness.cell_scene import ArmSettings
from symbolic.array import Array

Control = Literal["impedance", "leader", "both"]
CONTROLS: tuple[Control, ...] = get_args(Control)

TOUCHES = 5.0
"""Reference of a normal force from which on force control has taken over whole [N]."""


@dataclass(frozen=True, eq=False)
class ArmState:
    """One arm at one moment.

    Attributes:
        error, error_rate: (n_joints,) reference less position, and its rate [rad, s].
        jacobian: (6, n_joints) of the pad, linear velocities first, world axes.
        normal: (3,) of the pad, into the box.
        force: normal force, as measured or as both arms share it [N].
    """

    error: Array
    error_rate: Array
    jacobian: Array
    normal: Array
    force: float


@dataclass(frozen=True, eq=False)
class ArmCommand:
    """References of one arm at one moment.

    Attributes:
        effort: (n_joints,) to feed forward [N m].
        normal_force: reference [N].
    """

    effort: Array
    normal_force: float


class ArmController:
    """One arm's controller, which remembers the integral of its force error.

    Attributes:
        is_force_controlled: whether it controls its force along the normal.
    """

    def __init__(
        self,
        settings: ArmSettings,
        gains: tuple[Array, Array],
        is_force_controlled: bool,
        drift_stiffness: float,
    ) -> None:
        """Start with no integral.

        Args:
            gains: stiffness and damping of the joints [N m/rad, N m s/rad].
            drift_stiffness: what is left of it along the normal [N/m].
        """
        self.is_force_controlled = is_force_controlled
        self._settings = settings
        self._stiffness, self._damping = gains
        self._drift_stiffness = drift_stiffness
        self._integral = 0.0

    def torque(self, command: ArmCommand, state: ArmState) -> Array:
        """(n_joints,) joint torques [N m]."""
        error, pressed = state.error, 0.0
        along = state.normal @ state.jacobian[:3]
        touches = min(1.0, max(0.0, command.normal_force / TOUCHES))
        if self.is_force_controlled and touches > 0.0:
            distance = float(along @ error)
            missing = command.normal_force - state.force
            if touches == 1.0 and state.force > 0.0:
                gain = self._settings.force_gain * self._settings.control_period
                self._integral += gain * missing
            pressed = touches * (self._integral + self._drift_stiffness * distance)
            # Without the part that moves the pad along its normal.
            moved = np.concatenate([distance * state.normal, np.zeros(3)])
            error = error - touches * np.linalg.pinv(state.jacobian) @ moved
        sprung: Array = self._stiffness * error + self._damping * state.error_rate
        return command.effort + sprung + pressed * along


def controllers(
    control: Control,
    leader: int,
    settings: ArmSettings,
    gains: tuple[tuple[Array, Array], tuple[Array, Array]],
) -> tuple[ArmController, ArmController]:
    """One controller per arm.

    Args:
        leader: index of the arm that keeps its place under `leader`.
        gains: per arm stiffness and damping of its joints [N m/rad, N m s/rad].
    """

    def one(i: int) -> ArmController:
        by_force = control == "both" or (control == "leader" and i != leader)
        drift = settings.drift_stiffness if control == "both" else 0.0
        return ArmController(settings, gains[i], by_force, drift)

    return one(0), one(1)
