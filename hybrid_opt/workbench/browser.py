"""A session in a browser: handles to drag, fields for numbers, the verdict and the forces."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hybrid_opt.bundles.bundle import TARGETS
from hybrid_opt.cell import Cell
from hybrid_opt.display.solids import Solid, cell_solids, frame_placements, motion_points
from hybrid_opt.errors import DisplayError
from hybrid_opt.workbench.session import Handle, Session, Verdict, handles, moved
from symbolic.array import Array
from symbolic.errors import DualArmError

HOST = "127.0.0.1"

COLOURS = {"robot": (148, 156, 166), "payload": (222, 158, 64), "environment": (196, 202, 208)}
TOUCHED = (206, 66, 60)

FRAME = 0.04
"""Time between two frames of a carry that plays [s]."""

NUMBERS = {"payload.mass": "mass [kg]", "contacts.friction": "friction"}
"""Fields, by key path of the workcell file."""


class Workbench:
    """A cell in a browser, served on this machine alone.

    One thread works: it takes what was asked last, so that dragging never queues.

    Attributes:
        session: what is looked at.
        url: of the page.
    """

    def __init__(self, session: Session, port: int = 8080, seed: int = 1) -> None:
        """Serve it.

        Args:
            port: where to listen; another free one is taken if it is in use.
            seed: of searches.

        Raises:
            DisplayError: viser is missing.
        """
        try:
            import viser
        except ImportError as error:
            raise DisplayError(
                "the live view needs viser: pip install 'dual-arm-carry[live]'"
            ) from error
        self.session = session
        self._rng = np.random.default_rng(seed)
        self._news = threading.Condition()
        self._changes: dict[str, Any] = {}
        self._tasks: list[Callable[[], None]] = []
        self._closed = False
        self._solids: dict[str, tuple[Solid, Any]] = {}
        self._server = viser.ViserServer(HOST, port, label="dual-arm carry", verbose=False)
        self.url = f"http://{HOST}:{self._server.get_port()}"
        self._server.gui.configure_theme(show_logo=False, show_share_button=False)
        self._build()
        self._show(session.verdict)
        self._look()
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def ask(self, changes: dict[str, Any]) -> None:
        """Have changes judged; of several that wait, the last of a key counts."""
        with self._news:
            self._changes |= changes
            self._news.notify()

    def do(self, task: Callable[[], None]) -> None:
        """Have something done beside judging, in the order of asking."""
        with self._news:
            self._tasks.append(task)
            self._news.notify()

    def close(self) -> None:
        """End it."""
        with self._news:
            self._closed = True
            self._news.notify()
        self._thread.join()
        self._server.stop()

    def _repr_html_(self) -> str:
        return f'<iframe src="{self.url}" style="width:100%;height:640px;border:0"></iframe>'

    # --- the page ---

    def _build(self) -> None:
        gui, workcell = self._server.gui, self.session.cell.workcell
        self._verdict = gui.add_markdown("")
        known = {handle.title: handle for handle in handles(workcell)}
        choice = gui.add_dropdown("drag", ["nothing", *known], initial_value="nothing")
        choice.on_update(lambda _: self._grasp(known.get(choice.value)))
        self._gizmo: Any = None
        starts = {
            "payload.mass": workcell.payload.mass,
            "contacts.friction": workcell.contacts[0].friction,
        }
        for key, label in NUMBERS.items():
            self._field(key, gui.add_number(label, starts[key], min=1e-3, step=0.01))
        low, high = workcell.task.force_limit
        limit = gui.add_slider("force limit [N]", low, high, 0.1, float(self.session.x[-1]))
        limit.on_update(lambda _: self.ask({"force_limit": limit.value}))
        self._limit: Any = limit
        self._place: Any = gui.add_slider("place [%]", 0, 100, 1, 0)
        self._place.on_update(lambda _: self.ask({}))
        self._plays = gui.add_checkbox("play", False)
        self._plays.on_update(lambda _: self.ask({}))
        gui.add_button("optimise from here").on_click(lambda _: self.do(self._optimise))
        self._itself = gui.add_checkbox("optimise when at rest", False)
        names = [robot.name for robot in workcell.robots]
        rows = tuple(np.zeros(2) for _ in range(5))
        lines = ("#1f6fb4", "#d1603d", "#1f6fb4", "#d1603d")
        labels = [*(f"{name}, least" for name in names), *(f"{name}, pressed" for name in names)]
        series: list[Any] = [{"label": "time [s]"}]
        for k, (label, colour) in enumerate(zip(labels, lines, strict=True)):
            series.append({"label": label, "stroke": colour, "width": 1 + 2 * (k > 1)})
        self._plot = gui.add_uplot(
            rows,
            tuple(series),
            title="normal forces [N]",
            scales={"x": {"time": False}},
            aspect=1.4,
        )
        folder = gui.add_text("folder", "live")
        gui.add_button("save the cell").on_click(
            lambda _: self.do(lambda: self._told(f"saved: {self.session.save(folder.value)}"))
        )
        target = gui.add_dropdown("target", list(TARGETS), initial_value="ros2-control")
        gui.add_button("export the job").on_click(
            lambda _: self.do(
                lambda: self._told(
                    f"written: {self.session.export(target.value, folder.value)[0].parent}"
                )
            )
        )

    def _look(self) -> None:
        """Begin where the whole motion is seen from the front, above."""
        carry = self.session.verdict.carry
        assert carry is not None, "a session begins with a carry"
        points = motion_points(self._geometry, carry.pose, carry.q)
        lower, upper = points.min(axis=0), points.max(axis=0)
        centre, far = (lower + upper) / 2.0, float(np.linalg.norm(upper - lower))
        self._server.initial_camera.look_at = centre
        self._server.initial_camera.position = centre + far * np.array([-0.75, -0.45, 0.5])

    def _field(self, key: str, field: Any) -> None:
        field.on_update(lambda _: self.ask({key: field.value}))

    def _grasp(self, handle: Handle | None) -> None:
        """Show the arrows of one handle, or of none."""
        if self._gizmo is not None:
            self._gizmo.remove()
            self._gizmo = None
        if handle is None:
            return
        now = {one.key: one for one in handles(self.session.cell.workcell)}[handle.key]
        gizmo = self._server.scene.add_transform_controls(
            "/handle",
            scale=0.25,
            disable_rotations=not now.turns,
            position=now.pose[:3, 3],
            wxyz=_quaternion(now.pose[:3, :3]),
            depth_test=False,
        )
        self._gizmo = gizmo

        @gizmo.on_update
        def _(_: Any) -> None:
            w, x, y, z = gizmo.wxyz
            pose = np.eye(4)
            pose[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
            pose[:3, 3] = gizmo.position
            self.ask(moved(self.session.cell.workcell, now, pose))

    # --- the one thread that works ---

    def _work(self) -> None:
        last, rested = time.perf_counter(), True
        while True:
            with self._news:
                if not (self._changes or self._tasks or self._closed):
                    self._news.wait(FRAME if self._plays.value else 0.5)
                if self._closed:
                    return
                changes, self._changes = self._changes, {}
                task = self._tasks.pop(0) if self._tasks else None
            try:
                if changes:
                    self._show(self.session.change(changes))
                    rested = False
                elif not rested and task is None and self._itself.value:
                    self._optimise()
                    rested = True
                if task is not None:
                    task()
            except DualArmError as error:
                self._told(str(error))
            now = time.perf_counter()
            if self._plays.value:
                carry = self.session.verdict.carry
                duration = carry.duration if carry is not None else 1.0
                self._place.value = round(self._place.value + 100.0 * (now - last) / duration) % 101
            last = now
            self._pose()

    def _optimise(self) -> None:
        self._told("optimising ...")
        self._show(self.session.optimise(self._rng))

    def _told(self, text: str) -> None:
        self._verdict.content = text

    def _show(self, verdict: Verdict) -> None:
        state, _, rest = verdict.text.partition(" ")
        self._told(f"**{state}** {rest}\n\njudged in {1e3 * verdict.seconds:.1f} ms")
        if verdict.carry is None:
            return
        carry = verdict.carry
        pressed = carry.normal_force if verdict.commanded is None else verdict.commanded
        columns = (carry.time - carry.time[0], *carry.normal_force.T, *pressed.T)
        self._plot.data = tuple(np.ascontiguousarray(column) for column in columns)
        self._limit.value = float(self.session.x[-1])
        self._draw(verdict)
        self._pose()

    def _draw(self, verdict: Verdict) -> None:
        """Meshes of bodies that are new, or changed their shape or place."""
        assert verdict.cell is not None
        self._geometry = verdict.cell.geometry
        scene = self._server.scene
        for solid in cell_solids(self._geometry):
            known = self._solids.get(solid.name)
            if known is not None and known[0] is solid:
                continue
            mesh = scene.add_mesh_simple(
                f"/bodies/{solid.name.replace('/', ' ')}",
                solid.vertices,
                solid.faces,
                color=COLOURS.get(solid.group, COLOURS["robot"]),
                flat_shading=True,
                side="double",
            )
            self._solids[solid.name] = (solid, mesh)

    def _pose(self) -> None:
        """Everything that moves, where it is at the place that is looked at."""
        carry = self.session.verdict.carry
        if carry is None:
            return
        sample = round(self._place.value / 100.0 * (len(carry) - 1))
        rows = slice(sample, sample + 1)
        placed = frame_placements(self._geometry, carry.pose[rows], carry.q[rows])
        with self._server.atomic():
            for solid, mesh in self._solids.values():
                if solid.frame.kind != "world":
                    T = placed[solid.frame][0]
                    mesh.position = T[:3, 3]
                    mesh.wxyz = _quaternion(T[:3, :3])


def live(cell: Cell, port: int = 8080, x: Array | None = None) -> Workbench:
    """Open a cell in a browser of this machine, to be changed by hand.

    Args:
        port: where to listen; another free one is taken if it is in use.
        x: (n_var,) the carry to look at, a decision vector of `cell.drivable()`; None for the
            hand-made one.

    Raises:
        DisplayError: viser is missing.
        DualArmError: the cell has no drivable form.
    """
    return Workbench(Session(cell, x), port)


def _quaternion(rotation: Array) -> Array:
    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    return np.array([w, x, y, z])
