"""Both pads and the box between them in a simulated cell: their contacts, and how the box slips."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hybrid_opt.witness.scene import rim
from hybrid_opt.witness.simulate import RIM_POINTS
from symbolic.array import Array
from symbolic.records import Workcell

Indices = NDArray[np.int64]


class Pads:
    """Reads one simulation's state, and mends what its contacts neglect.

    Attributes:
        sites: of the two pads.
    """

    def __init__(self, mujoco: ModuleType, model: Any, data: Any, workcell: Workcell) -> None:
        """Find pads and box in the model of `hybrid_opt.witness.cell_scene`."""
        self._mujoco, self._model, self._data = mujoco, model, data
        self.sites = [int(model.site(f"pad_{i + 1}").id) for i in (0, 1)]
        self._bodies = [int(model.site_bodyid[site]) for site in self.sites]
        self._box_body = int(model.body("box").id)
        first = int(model.joint("box").qposadr[0])
        self._box_pose = slice(first, first + 7)
        self._pad_of_geom = np.full(model.ngeom, -1)
        for i, body in enumerate(self._bodies):
            self._pad_of_geom[(model.geom_bodyid == body) & (model.geom_contype == 1)] = i
        rims = np.array([rim(contact, RIM_POINTS) for contact in workcell.contacts])
        self._rims = np.concatenate([rims, np.zeros((2, RIM_POINTS, 1))], axis=2)
        self._contact_time = float(model.geom_solref[self._pad_of_geom >= 0, 0].max())
        self._change = np.zeros((3, model.nv))

    @property
    def normal_forces(self) -> Array:
        """(2,) what the points of each pad press together, in the last step [N]."""
        pad, _, address, _ = self._contacts()
        force = np.zeros(2)
        np.add.at(force, pad, self._data.efc_force[address])
        return force

    def mend_contacts(self) -> None:
        """Contacts of this step, all accelerations included.

        MuJoCo takes J dv/dt for the acceleration of the box over a pad, which has dJ/dt v besides:
        some tenths of m/s^2 where arms swing. Contacts that do not know it creep by millimetres
        per second and lift off. Call it between the two halves of a step.

        A step takes joints along arcs and the box along a line, which parts them by half of
        dJ/dt v dt^2. The contacts' damping, 2 over their time constant, is told to make up for it.
        """
        pad, is_first, address, axes = self._contacts()
        if not len(pad):
            return
        share = 1.0 - self._model.opt.timestep / self._contact_time
        unseen = share * np.array([self._unseen(i) for i in (0, 1)])[pad]
        sign = np.where(is_first, -1.0, 1.0)[:, None]  # the second body's less the first's
        rows = address[:, None] + np.arange(3)
        self._data.efc_aref[rows] -= sign * np.einsum("nij,nj->ni", axes, unseen)

    @property
    def rims_on_box(self) -> Array:
        """(2, RIM_POINTS, 3) the patches' rims in the box frame [m]."""
        (places, axes), (position, rotation) = self._placed(), self.box
        world = self._rims @ np.swapaxes(axes, 1, 2) + places[:, None]
        on_box: Array = (world - position) @ rotation
        return on_box

    def slip(self, on_box: Array) -> Array:
        """(2,) how far points of the box, once on the rims, are from there in the planes of the
        pads [m]."""
        (places, axes), (position, rotation) = self._placed(), self.box
        world = on_box @ rotation.T + position
        moved = (world - places[:, None]) @ axes - self._rims
        largest: Array = np.linalg.norm(moved[..., :2], axis=2).max(axis=1)
        return largest

    @property
    def box(self) -> tuple[Array, Array]:
        """Position (3,) [m] and rotation (3, 3) of the box frame in the world."""
        pose = self._data.qpos[self._box_pose]
        return pose[:3].copy(), Rotation.from_quat(pose[[4, 5, 6, 3]]).as_matrix()

    @property
    def box_in_pad(self) -> Array:
        """(3, 3) rotation of the box in the axes of the first pad."""
        in_pad: Array = self._placed()[1][0].T @ self.box[1]
        return in_pad

    def _unseen(self, pad: int) -> Array:
        """(3,) dJ/dt v of a pad less that of the box beneath it, world axes [m/s^2]."""
        place, found = self._data.site_xpos[self.sites[pad]], []
        for body in (self._bodies[pad], self._box_body):
            self._mujoco.mj_jacDot(self._model, self._data, self._change, None, place, body)
            found.append(self._change @ self._data.qvel)
        less: Array = found[0] - found[1]
        return less

    def _contacts(self) -> tuple[Indices, NDArray[np.bool_], Indices, Array]:
        """The pads' active contacts: the pad (n,), whether it is the first body (n,), the first of
        three rows among the constraints (n,), the contact's axes as rows (n, 3, 3)."""
        contact = self._data.contact
        sides = self._pad_of_geom[contact.geom]
        pad = sides.max(axis=1)
        active = (pad >= 0) & (contact.efc_address >= 0)
        axes = contact.frame[active].reshape(-1, 3, 3)
        return pad[active], sides[active, 0] >= 0, contact.efc_address[active], axes

    def _placed(self) -> tuple[Array, Array]:
        """Places (2, 3) and axes (2, 3, 3) of both pads in the world."""
        return self._data.site_xpos[self.sites], self._data.site_xmat[self.sites].reshape(2, 3, 3)
