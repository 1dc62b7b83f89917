"""A driven box in MuJoCo: pressed with a multiple of a force, does it stay in place?

The carriage is set to the planned state of the box frame at every step and accelerated as planned
within it, so that the pads move exactly as planned; the box, free, is held by friction alone.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from hybrid_opt.witness.drive import Drive
from hybrid_opt.witness.outcome import Outcome, Threshold, bisected, mujoco_module
from hybrid_opt.witness.scene import CARRIAGE_MASS, SimulationSettings, rim, scene_text, tilt_names
from symbolic.array import Array
from symbolic.records import Workcell

LOOKED_AT = 1e-3
"""Time between two looks at the slip [s]."""

RIM_POINTS = 8
"""Places on the rim of each robot's first patch where the slip is measured."""


class Witness:
    """The box of one workcell between its pads.

    Attributes:
        workcell, settings: what is simulated, and how.
    """

    def __init__(
        self,
        workcell: Workcell,
        settings: SimulationSettings | None = None,
        disturbance: ArrayLike = (0.0, 0.0, 0.0),
    ) -> None:
        """Describe the scene; nothing is simulated yet.

        Args:
            disturbance: (3,) acceleration beside the motion's, world frame [m/s^2].

        Raises:
            WitnessError: MuJoCo is not installed.
        """
        self.workcell = workcell
        self.settings = settings or SimulationSettings()
        self._mujoco = mujoco_module()
        self._disturbance = disturbance
        self._models: dict[int, Any] = {}
        pads = [(contact.T_box_pad, rim(contact, RIM_POINTS)) for contact in workcell.contacts]
        self._normals = np.array([T[:3, 2] for T, _ in pads])[:, None]
        self._rims = np.array([T[:3, 3] + around @ T[:3, :2].T for T, around in pads])

    def simulate(self, drive: Drive, factor: float = 1.0) -> Outcome:
        """One carry with the pressing force times a factor, up to its end or to a slip."""
        mujoco, model, settings = self._mujoco, self._model(drive.leader), self.settings
        data = mujoco.MjData(model)
        box = int(model.joint("box").qposadr[0])
        press = int(model.joint("press").dofadr[0])
        pads = ("pad_1", "pad_2") if settings.tilt_stiffness is not None else ()
        names = [tilt_names(pad) for pad in pads]
        joints = [[int(model.joint(name).dofadr[0]) for name in both] for both in names]
        tilts = np.array(joints, int).reshape(-1, 2)
        data.qpos[:3], data.qpos[3:7] = drive.position[0], drive.quaternion[0]
        data.qpos[box : box + 3], data.qpos[box + 3 : box + 7] = data.qpos[:3], data.qpos[3:7]
        force = factor * drive.press + drive.own
        every = max(1, round(LOOKED_AT / settings.time_step))
        settled: tuple[Array, Array] | None = None
        time, slip, turn = [], [], []
        for k in range(len(drive.time) - 1):
            data.qpos[:3], data.qpos[3:7] = drive.position[k], drive.quaternion[k]
            data.qvel[:3], data.qvel[3:6] = drive.velocity[k], drive.spin[k]
            data.qfrc_applied[:3] = CARRIAGE_MASS * drive.acceleration[k]
            data.qfrc_applied[3:6] = CARRIAGE_MASS * drive.spin_rate[k]
            data.qfrc_applied[press] = force[k]
            data.qfrc_applied[tilts] = drive.tilt[k, : len(tilts)]
            mujoco.mj_step(model, data)
            if k % every or drive.time[k] < drive.time[0] + settings.settle / 2.0:
                continue
            moved, turned = self._displaced(drive, k + 1, data.qpos[box : box + 7])
            settled = settled or (moved, turned)
            time.append(float(drive.time[k + 1]))
            slip.append(np.linalg.norm(moved - settled[0], axis=2).max(axis=1))
            turn.append(float(Rotation.from_matrix(settled[1].T @ turned).magnitude()))
            if not slip[-1].max() <= settings.slip:
                return Outcome(factor, False, np.array(time), np.array(slip), np.array(turn))
        return Outcome(factor, True, np.array(time), np.array(slip), np.array(turn))

    def threshold(self, drive: Drive, low: float, high: float, steps: int) -> Threshold[Outcome]:
        """The least factor that holds, by bisection.

        Args:
            low, high: factors between which it is looked for.
            steps: bisections.

        Raises:
            WitnessError: the box holds at the lower or slips at the higher factor.
        """
        return bisected(lambda factor: self.simulate(drive, factor), low, high, steps)

    def _model(self, leader: int) -> Any:
        if leader not in self._models:
            text = scene_text(self.workcell, self.settings, leader, self._disturbance)
            self._models[leader] = self._mujoco.MjModel.from_xml_string(text)
        return self._models[leader]

    def _displaced(self, drive: Drive, k: int, pose: Array) -> tuple[Array, Array]:
        """Displacements (2, RIM_POINTS, 3) in the planes of the pads, and rotation (3, 3), of the
        box on the carriage."""
        R_world_box = Rotation.from_quat(pose[[4, 5, 6, 3]]).as_matrix()
        turned = drive.rotation[k].T @ R_world_box
        offset = drive.rotation[k].T @ (pose[:3] - drive.position[k])
        moved = self._rims @ turned.T + offset - self._rims
        along = (moved * self._normals).sum(axis=2, keepdims=True)
        return moved - along * self._normals, turned
