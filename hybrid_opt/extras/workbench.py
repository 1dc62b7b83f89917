"""A cell that is changed interactively, with a carry evaluated after every change: a session, and
its page in a browser with handles to drag, fields for numbers, verdict and forces."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hybrid_opt.api import save, time_path
from hybrid_opt.carry import Carry
from hybrid_opt.cell import Cell
from hybrid_opt.display.solids import Solid, cell_solids, frame_placements, motion_points
from hybrid_opt.errors import DisplayError, ResultsError
from hybrid_opt.evaluate.explanation import explain
from hybrid_opt.extras.bundles.bundle import export
from hybrid_opt.extras.bundles.targets import TARGETS
from hybrid_opt.front import search
from hybrid_opt.job.plan import plan_job
from hybrid_opt.metaheuristics.run import SearchSettings
from hybrid_opt.robust.squeeze import Squeeze, SqueezeSettings, commanded_forces
from hybrid_opt.timing.records import TimingLimits
from symbolic.array import Array
from symbolic.errors import DualArmError, WorkcellError
from symbolic.path.spline import coarse_task, resample_decisions
from symbolic.read.cell_files import collect_cell, unpack_cell
from symbolic.records import POSE_SIZE, Workcell
from symbolic.records.poses import box_placement, inverse, rpy_from_rotation, transform

SEARCH_EVALUATIONS = 400
"""Number of candidates of a search around the present carry, which takes 1.6 s for the rack."""

SEARCH_WIDTH = 0.05
"""Standard deviation of the search's first generation around the present carry, as a share of the
width of the bounds."""

FIRST = 39
"""Number of random candidates in that generation; with the present carry it is one population."""


@dataclass(frozen=True)
class Handle:
    """A part of a cell that can be dragged to another pose.

    Attributes:
        key: key in the workcell file: 'task.start', 'environment.top board', 'robots[0].base' or
            'contacts[0]'.
        title: name of the part for people.
        pose: (4, 4) pose of the part in the world.
        turns: True if the part may be rotated; a pad stays on its face.
    """

    key: str
    title: str
    pose: Array
    turns: bool = True


@dataclass(frozen=True, eq=False)
class SessionVerdict:
    """Result of evaluating a carry in a changed cell.

    Attributes:
        cell: the changed cell in its drivable form; None if the change is refused.
        carry: the carry in the changed cell; None if the change is refused.
        text: text that says whether the carry is feasible, with the reason if it is not.
        feasible: True if the carry is feasible.
        commanded: (n, 2) commanded normal force of each arm at the samples [N]; None if the carry
            is not feasible.
        squeeze: how the commanded forces were chosen; None if there are none.
        seconds: computing time of the verdict [s].
    """

    cell: Cell | None
    carry: Carry | None
    text: str
    feasible: bool
    commanded: Array | None
    squeeze: Squeeze | None
    seconds: float


class Session:
    """A cell that is changed interactively, and one carry that is evaluated after each change.

    Attributes:
        base: the unchanged cell.
        changes: changed values by key path of the workcell file, as for `Cell.changed`.
        x: (n_var,) decision vector of the carry in the drivable form of the cell.
        verdict: result of the last evaluation.
    """

    def __init__(self, cell: Cell, x: Array | None = None) -> None:
        """Open a session and evaluate its carry.

        Args:
            cell: the cell.
            x: (n_var,) decision vector of a carry of `cell.drivable()`; None for the hand-made
                carry.

        Raises:
            DualArmError: the cell has no drivable form, or x does not fit.
        """
        self.base = cell
        self._drivable = cell if cell.workcell.task.law.is_drivable else cell.drivable()
        self.changes: dict[str, Any] = {}
        self.x = np.array(self._drivable.initial if x is None else x, dtype=float)
        self.verdict = self._judged(self._drivable)

    @property
    def cell(self) -> Cell:
        """The changed cell in its drivable form."""
        return self.verdict.cell or self._drivable

    def change(self, changes: Mapping[str, Any]) -> SessionVerdict:
        """Change further values of the cell, in addition to earlier changes, and evaluate the
        carry. A refused change leaves the session unchanged.

        Args:
            changes: new values by key path of the workcell file; the key 'force_limit' stands for
                the force limit of the carry [N].
        """
        begin = time.perf_counter()
        wanted = self.changes | dict(changes)
        limit = wanted.pop("force_limit", None)
        try:
            cell = self._drivable.changed(wanted) if wanted else self._drivable
        except WorkcellError as error:
            text = "; ".join(error.problems)
            took = time.perf_counter() - begin
            return SessionVerdict(None, None, f"refused: {text}", False, None, None, took)
        if limit is not None:
            low, high = cell.workcell.task.force_limit
            self.x[-1] = min(max(float(limit), low), high)
        self.changes = wanted
        self.verdict = self._judged(cell, begin)
        return self.verdict

    def move(self, handle: Handle, pose: Array) -> SessionVerdict:
        """Move a part of the cell and evaluate the carry.

        Args:
            handle: the part.
            pose: (4, 4) its new pose in the world.
        """
        return self.change(moved(self.cell.workcell, handle, pose))

    def optimise(
        self, rng: np.random.Generator, evaluations: int = SEARCH_EVALUATIONS
    ) -> SessionVerdict:
        """Search near the present carry for a carry with a smaller product of duration and force,
        make the best one found the present carry, and return its verdict.

        Args:
            rng: random generator of the search.
            evaluations: number of candidates.
        """
        task, cell = self.cell.workcell.task, self.cell
        width = np.where(np.isfinite(task.upper - task.lower), task.upper - task.lower, 0.0)
        near = self.x + SEARCH_WIDTH * width * rng.standard_normal((FIRST, task.n_var))
        first = np.clip(np.vstack([self.x, near]), task.lower, task.upper)
        settings = SearchSettings(initial=first)
        front = search(cell, evaluations=evaluations, rng=rng, settings=settings)
        # The path at hand may have waypoints between those that a search draws.
        tried = cell.evaluator.certified(cell.evaluate(np.vstack([self.x, front.x])))
        if tried.feasible.any():
            product = np.where(tried.feasible, np.prod(tried.objectives, axis=1), np.inf)
            self.x = np.array(tried.x[np.argmin(product)])
        self.verdict = self._judged(cell)
        return self.verdict

    def save(self, folder: str | Path) -> Path:
        """Write the changed cell into a folder, with all files that it needs and the present carry
        as its hand-made trajectory. Return the path of the workcell file.

        Args:
            folder: a folder that is empty or does not exist yet.

        Raises:
            DualArmError: the folder is not empty, or cannot be written.
        """
        folder = Path(folder)
        if folder.exists() and any(folder.iterdir()):
            raise ResultsError(
                f"{folder}: is not empty; save the cell into a folder of its own", code="not-empty"
            )
        task = coarse_task(self.base.workcell.task)
        (x,) = resample_decisions(self.x, self.cell.workcell.task, task)
        poses = x[: task.n_box].reshape(-1, POSE_SIZE)
        cell = self.base.changed(self.changes | {"task.initial": poses.tolist()})
        return unpack_cell(collect_cell(cell.workcell), folder).source

    def export(self, target: str, folder: str | Path) -> tuple[Path, ...]:
        """Write the job around the present carry as a bundle for robots, and the carry as
        carry.json.

        Args:
            target: name of the bundle's target.
            folder: folder of the bundle.

        Returns:
            Paths of all written files.

        Raises:
            DualArmError: the carry is not feasible, or the target does not support it.
        """
        carry = self.verdict.carry
        if carry is None or not self.verdict.feasible:
            raise ResultsError(f"this carry cannot be driven: {self.verdict.text}")
        limits = TimingLimits(force=float(self.x[-1]))
        timing = time_path(self.cell, carry, limits)
        Path(folder).mkdir(parents=True, exist_ok=True)
        save(carry, Path(folder) / "carry.json", {"by": "hand"})
        return export(plan_job(timing), target, folder)

    def _judged(self, cell: Cell, begin: float | None = None) -> SessionVerdict:
        begin = time.perf_counter() if begin is None else begin
        carry = cell.carry(self.x)
        judgement = carry.judgement
        assert judgement is not None, "a cell judges its carries"
        commanded, squeeze = None, None
        text = f"feasible, {carry.duration:.3f} s"
        if judgement.feasible:
            try:
                given = cell.workcell, carry, SqueezeSettings()
                commanded, squeeze = commanded_forces(*given, itemised=False)
                most = cell.workcell.task.reference_force
                text += f", {squeeze.order} {squeeze.force:.1f} N"
                if (commanded.max(axis=0) > most).any():
                    text += f", more than the reference force of {most.min():.1f} N"
            except DualArmError as error:
                text += f"; {error}"
        else:
            text = f"infeasible: {explain(cell.evaluator, cell.evaluate(self.x))[0]}"
        took = time.perf_counter() - begin
        return SessionVerdict(cell, carry, text, judgement.feasible, commanded, squeeze, took)


def handles(workcell: Workcell) -> tuple[Handle, ...]:
    """Return the parts of a cell that can be dragged: start, goal, bodies of the environment, bases
    and pads, in this order.

    Args:
        workcell: the cell.
    """
    task, bodies = workcell.task, workcell.environment
    first, last = (
        box_placement(task.orientation, task.waypoints[k].lower[:POSE_SIZE]) for k in (0, -1)
    )
    found = [Handle("task.start", "start", first), Handle("task.goal", "goal", last)]
    names = [body.name for body in bodies]
    found += [
        Handle(f"environment.{body.name}", body.name, body.pose)
        for body in bodies
        if names.count(body.name) == 1
    ]
    for k, robot in enumerate(workcell.robots):
        found.append(Handle(f"robots[{k}].base", f"base of {robot.name}", robot.T_world_base))
    for k, (robot, contact) in enumerate(zip(workcell.robots, workcell.contacts, strict=True)):
        pose = first @ contact.T_box_pad
        found.append(Handle(f"contacts[{k}]", f"pad of {robot.name}", pose, turns=False))
    return tuple(found)


def moved(workcell: Workcell, handle: Handle, pose: Array) -> dict[str, Any]:
    """Return the changes of the workcell file that move a part of the cell.

    Args:
        workcell: the cell.
        handle: the part.
        pose: (4, 4) its new pose in the world.

    Returns:
        Changed values by key path, as for `Cell.changed`.
    """
    xyz = [round(value, 6) for value in pose[:3, 3].tolist()]
    rpy = [round(value, 6) for value in rpy_from_rotation(pose[:3, :3]).tolist()]
    section = handle.key.partition(".")[0].partition("[")[0]
    if section == "task":
        orientation = workcell.task.orientation
        if orientation.is_vector:
            turn = Rotation.from_matrix(pose[:3, :3] @ orientation.reference.T)
            rpy = [round(value, 6) for value in turn.as_rotvec().tolist()]
        return {handle.key: [*xyz, *rpy]}
    if section == "robots":
        return {handle.key: {"xyz": xyz, "rpy": rpy}}
    if section == "environment":
        return {f"{handle.key}.xyz": xyz, f"{handle.key}.rpy": rpy}
    contact = workcell.contacts[int(handle.key[len("contacts[") : -1])]
    task = workcell.task
    box = box_placement(task.orientation, task.waypoints[0].lower[:POSE_SIZE])
    shift = (inverse(box) @ pose)[:3, 3] - contact.T_box_pad[:3, 3]
    normal = contact.T_box_pad[:3, 2]
    place = contact.T_box_pad[:3, 3] + shift - normal * (normal @ shift)
    return {f"{handle.key}.xyz": [round(value, 6) for value in place.tolist()]}


# --- in a browser ---


LOCAL_HOST = "127.0.0.1"

GROUP_COLOURS = {
    "robot": (148, 156, 166),
    "payload": (222, 158, 64),
    "environment": (196, 202, 208),
}

FRAME = 0.04
"""Time between two frames of a carry that plays [s]."""


class Workbench:
    """A page in the browser on which a cell is changed and its carry shown. It is served to this
    machine only.

    One thread does all work. It always takes the latest request, so that dragging never makes
    requests queue.

    Attributes:
        session: the session that the page shows.
        url: address of the page.
    """

    def __init__(self, session: Session, port: int = 8080, seed: int = 1) -> None:
        """Start to serve a session.

        Args:
            session: the session.
            port: port of the page; another free one is taken if it is in use.
            seed: seed of the random numbers of searches.

        Raises:
            DisplayError: the package viser is not installed.
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
        self._server = viser.ViserServer(LOCAL_HOST, port, label="dual-arm carry", verbose=False)
        self.url = f"http://{LOCAL_HOST}:{self._server.get_port()}"
        self._server.gui.configure_theme(show_logo=False, show_share_button=False)
        self._build()
        self._show(session.verdict)
        self._look()
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def ask(self, changes: dict[str, Any]) -> None:
        """Request an evaluation with changed values. Requests that come before the evaluation
        begins are merged; of each key the last value counts.

        Args:
            changes: new values by key path of the workcell file.
        """
        with self._news:
            self._changes |= changes
            self._news.notify()

    def do(self, task: Callable[[], None]) -> None:
        """Request a task; all tasks run one after the other in one thread.

        Args:
            task: function without arguments.
        """
        with self._news:
            self._tasks.append(task)
            self._news.notify()

    def close(self) -> None:
        """Stop serving."""
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
        for key, label, start in (
            ("payload.mass", "mass [kg]", workcell.payload.mass),
            ("contacts.friction", "friction", workcell.contacts[0].friction),
        ):
            self._field(key, gui.add_number(label, start, min=1e-3, step=0.01))
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
        target = gui.add_dropdown("target", list(TARGETS), initial_value="torque")
        gui.add_button("export the job").on_click(
            lambda _: self.do(
                lambda: self._told(
                    f"written: {self.session.export(target.value, folder.value)[0].parent}"
                )
            )
        )

    def _look(self) -> None:
        """Place the camera in front of the cell and above it, such that the whole motion is
        visible."""
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
        """Show the arrows for dragging at one part of the cell, and remove those shown before.

        Args:
            handle: the part; None for no arrows.
        """
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
            wxyz=Rotation.from_matrix(now.pose[:3, :3]).as_quat(scalar_first=True),
            depth_test=False,
        )
        self._gizmo = gizmo

        @gizmo.on_update
        def _(_: Any) -> None:
            turn = Rotation.from_quat(gizmo.wxyz, scalar_first=True).as_matrix()
            pose = transform(turn, gizmo.position)
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

    def _show(self, verdict: SessionVerdict) -> None:
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

    def _draw(self, verdict: SessionVerdict) -> None:
        """Redraw the meshes of bodies that are new, or whose shape or pose has changed.

        Args:
            verdict: verdict on the changed cell, which contains its geometry.
        """
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
                color=GROUP_COLOURS.get(solid.group, GROUP_COLOURS["robot"]),
                flat_shading=True,
                side="double",
            )
            self._solids[solid.name] = (solid, mesh)

    def _pose(self) -> None:
        """Place all moving bodies on the page as at the selected sample of the carry."""
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
                    mesh.wxyz = Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True)


def live(cell: Cell, port: int = 8080, x: Array | None = None) -> Workbench:
    """Open a page in the browser on which a cell is changed by hand.

    Args:
        cell: the cell.
        port: port of the page; if it is in use, a free one is taken.
        x: (n_var,) decision vector of a carry of `cell.drivable()`; None for the hand-made carry.

    Raises:
        DisplayError: viser is missing.
        DualArmError: the cell has no drivable form.
    """
    return Workbench(Session(cell, x), port)
