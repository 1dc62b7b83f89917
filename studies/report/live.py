"""A carry in viser's viewer, served on this machine."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from hybrid_opt.display.solids import Solid, cell_solids, frame_placements
from studies.errors import ReportError
from studies.report.data import DrawnCarry, gather_carries
from symbolic.array import Array
from symbolic.geometry.bodies import Frame
from symbolic.geometry.pairs import CellGeometry

if TYPE_CHECKING:
    import viser

COLOURS = {
    "robot 1": (59, 110, 168),
    "robot 2": (168, 115, 59),
    "payload": (201, 162, 39),
    "environment": (154, 163, 171),
}

PERIOD = 1.0 / 30.0
"""Between pictures [s]."""


class LiveView:
    """A cell and one or more carries in a browser window.

    Attributes:
        server: viser's server; its port is `server.get_port()`.
    """

    server: viser.ViserServer

    def __init__(
        self,
        geometry: CellGeometry,
        carries: tuple[DrawnCarry, ...],
        port: int = 8080,
        host: str = "127.0.0.1",
    ) -> None:
        """Start serving.

        Args:
            geometry: the cell.
            carries: to choose from, at least one.
            port: where to listen; another free one is taken if it is in use.
            host: address to listen on, by default only this machine's own.

        Raises:
            ReportError: viser is not installed.
        """
        try:
            import viser
        except ModuleNotFoundError as error:
            raise ReportError(
                'the live view needs viser: pip install "dual-arm-carry[view]"'
            ) from error
        self._geometry, self._carries = geometry, carries
        self.server = viser.ViserServer(host=host, port=port, verbose=False)
        self.server.scene.set_up_direction("+z")
        self._frames: dict[Frame, Any] = {}
        for k, solid in enumerate(cell_solids(geometry)):
            self._add(k, solid)
        gui = self.server.gui
        labels = [f"{k + 1}: {carry.label}" for k, carry in enumerate(carries)]
        self._choice = gui.add_dropdown("trajectory", labels, initial_value=labels[-1])
        self._playing = gui.add_checkbox("play", initial_value=True)
        self._speed = gui.add_slider("speed", min=0.1, max=4.0, step=0.1, initial_value=1.0)
        self._share: Any = gui.add_slider(
            "time [%]", min=0.0, max=100.0, step=0.1, initial_value=0.0
        )
        self.show(0.0)

    def show(self, share: float) -> None:
        """Place everything at a share in [0, 1] of the chosen carry's duration."""
        carry = self._carries[int(str(self._choice.value).split(":")[0]) - 1]
        timed = carry.timed
        moment = timed.time[0] + share * timed.duration
        pose = _at(moment, timed.time, timed.pose)
        q = _at(moment, timed.time, timed.q)
        placed = frame_placements(self._geometry, pose[None], q[None])
        with self.server.atomic():
            for frame, handle in self._frames.items():
                T = placed[frame][0]
                handle.position = T[:3, 3]
                handle.wxyz = _quaternion(T)

    def step(self, seconds: float) -> None:
        """Advance by so much real time, if it plays."""
        carry = self._carries[int(str(self._choice.value).split(":")[0]) - 1]
        share = float(self._share.value) / 100.0
        if self._playing.value:
            share += seconds * float(self._speed.value) / carry.timed.duration
            share = 0.0 if share > 1.0 else share
            self._share.value = 100.0 * share
        self.show(share)

    def serve(self) -> None:
        """Play until the process is interrupted."""
        last = time.perf_counter()
        while True:
            time.sleep(PERIOD)
            now = time.perf_counter()
            self.step(now - last)
            last = now

    def stop(self) -> None:
        """Stop serving."""
        self.server.stop()

    def _add(self, k: int, solid: Solid) -> None:
        if solid.frame not in self._frames:
            name = f"/{solid.frame.kind}{solid.frame.robot}{solid.frame.joint}"
            self._frames[solid.frame] = self.server.scene.add_frame(name, show_axes=False)
        parent = self._frames[solid.frame].name
        # Names of the cell may hold slashes, which are levels of viser's tree.
        self.server.scene.add_mesh_simple(
            f"{parent}/solid{k}",
            vertices=solid.vertices.astype(np.float32),
            faces=solid.faces.astype(np.uint32),
            color=COLOURS[solid.group],
            flat_shading=True,
        )


def watch(root: Path, port: int) -> None:
    """Show all selected trajectories until Ctrl-C.

    Raises:
        DualArmError: the results are incomplete or viser is missing.
    """
    view = LiveView(*gather_carries(root), port=port)
    address = f"http://{view.server.get_host()}:{view.server.get_port()}"
    print(f"Open {address} in a browser; Ctrl-C ends it.", file=sys.stderr)
    try:
        view.serve()
    except KeyboardInterrupt:
        view.stop()


def _at(moment: float, time_: Array, values: Array) -> Array:
    return np.array([np.interp(moment, time_, column) for column in values.T])


def _quaternion(T: Array) -> Array:
    """Unit quaternion (4,) as w x y z of a transform."""
    return np.asarray(Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True))
