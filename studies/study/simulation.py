"""The stages that time every selected trajectory as a robot can drive it, and that have selected
carries driven in the simulated cell, with their records (`timing/*.json`, `simulated/*.json`)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np

from hybrid_opt.campaign import CampaignFolder, Stage
from hybrid_opt.campaign.settings import (
    POLISHED_SUFFIX,
    RECOMMENDED_FILE,
    SELECTED,
    SIMULATED,
    UNION,
    polished_selected_file,
)
from hybrid_opt.campaign.stages import Cells, cells_of, ready_cells
from hybrid_opt.carry import Carry
from hybrid_opt.display.table import Table, number
from hybrid_opt.errors import ResultsError, SimulationError
from hybrid_opt.extras.simulation.arms import CarrySimulation, CellSimulation, simulate_carry
from hybrid_opt.extras.simulation.box import carriage_motion
from hybrid_opt.extras.simulation.hands import (
    HAND_SETTINGS,
    HandSimulation,
    hand_threshold,
    own_forces,
)
from hybrid_opt.extras.simulation.reference import Control, driven_carry
from hybrid_opt.metaheuristics.run import title
from hybrid_opt.progress import Progress
from hybrid_opt.robust.squeeze import SqueezeSettings, commanded_forces
from hybrid_opt.store.files import read_bytes, read_record, sha256, to_json, write_json
from hybrid_opt.store.trajectory_file import StoredTrajectory, read_trajectory
from hybrid_opt.timing.analysis import (
    TimingDocument,
    read_timing,
    time_trajectory,
    timing_document,
)
from hybrid_opt.timing.records import TimingStatus
from studies.study.recommendation import StoredRecommendation
from studies.study.summary import read_summary
from symbolic.array import Array, Figure, Row, Shape, evenly
from symbolic.contact.registry import contact_model
from symbolic.errors import SettingsError

MOST_SAMPLES = 240
"""Most samples of the force curves of a simulation that are stored."""


@dataclass(frozen=True)
class StoredSimulation:
    """Content of a file in `simulated/`: result of one carry in the simulated cell.

    Attributes:
        label: name of the carry.
        trajectory: SHA-256 of the carry's trajectory file.
        controller: name of the control law of both arms.
        problem: reason why there is no threshold or no simulation, else ''. Without a simulation
            the other values are the defaults.
        duration: duration of the carry [s].
        slips, holds: factors of the planned forces just below and just above the threshold of
            slipping; null if there is none.
        pad, begins: number of the pad that slips first just below the threshold, 1 or 2, 0 for
            none; and the time at which it begins to slip [s].
        robust: True if the stored simulation uses forces that hold the box in every case of the
            uncertainty.
        factor: factor of the planned forces in the stored simulation; null with robust forces.
        arrives: True if the box did not slip in the stored simulation and ended at its goal.
        slip, misses: largest slip of a pad and final distance of the box from its goal, in the
            stored simulation [m].
        time: (n,) times from the beginning of the carry [s].
        predicted, simulated: (n, 2) commanded and measured normal force of each robot in the stored
            simulation [N].
    """

    label: str
    trajectory: str
    controller: str
    problem: str
    duration: Figure = math.nan
    slips: Figure = math.nan
    holds: Figure = math.nan
    pad: int = 0
    begins: Figure = math.nan
    robust: bool = False
    factor: Figure = math.nan
    arrives: bool = False
    slip: Figure = math.nan
    misses: Figure = math.nan
    time: Row = field(default_factory=lambda: np.zeros(0))
    predicted: Annotated[Array, Shape((None, 2))] = field(default_factory=lambda: np.zeros((0, 2)))
    simulated: Annotated[Array, Shape((None, 2))] = field(default_factory=lambda: np.zeros((0, 2)))

    def __post_init__(self) -> None:
        """Raise a ValueError if the curves have different lengths."""
        if not len(self.time) == len(self.predicted) == len(self.simulated):
            raise ValueError("its curves have different lengths")

    @property
    def peaks(self) -> Array:
        """(2, 2) largest commanded (row 0) and measured (row 1) normal force of each robot [N]; NaN
        without samples."""
        if not len(self.time):
            return np.full((2, 2), np.nan)
        return np.stack([self.predicted.max(axis=0), self.simulated.max(axis=0)])

    @property
    def largest_error(self) -> float:
        """Largest difference of a measured from the commanded normal force, over the commanded
        force; NaN without samples."""
        if not len(self.time):
            return float("nan")
        return float(np.abs(self.simulated / self.predicted - 1.0).max())


def stored_simulation(
    found: CarrySimulation, label: str, trajectory: str, controller: str
) -> StoredSimulation:
    """Convert the result of a simulation to the record that is stored. Samples before the beginning
    of the carry are left out.

    Args:
        found: result of the simulation.
        label: name of the carry.
        trajectory: SHA-256 of the carry's file.
        controller: name of the control law of both arms.
    """
    threshold, shown, squeeze, motion = (
        found.threshold,
        found.shown,
        found.squeeze,
        found.reference.motion,
    )
    begin = float(motion.time[2])
    rows = np.flatnonzero(shown.time >= begin)
    rows = rows[evenly(len(rows), MOST_SAMPLES)] if len(rows) else np.array([len(shown.time) - 1])
    slipped: dict[str, Any] = {}
    if threshold is not None:
        slips, holds = threshold.slips, threshold.holds
        slipped = {"slips": slips.factor, "holds": holds.factor, "begins": slips.time[-1]}
        slipped["pad"] = slips.pad + 1
    return StoredSimulation(
        label=label,
        trajectory=trajectory,
        controller=controller,
        problem=found.problem,
        duration=float(motion.time[-1] - begin),
        robust=squeeze.factor is None,
        factor=math.nan if squeeze.factor is None else squeeze.factor,
        arrives=shown.arrives,
        slip=float(shown.slip.max()),
        misses=shown.misses,
        time=shown.time[rows] - begin,
        predicted=shown.normal_force_reference[rows],
        simulated=shown.normal_force[rows],
        **slipped,
    )


def read_simulations(root: Path) -> tuple[StoredSimulation, ...]:
    """Read the simulations of a study's carries, sorted by the names of the files.

    Raises:
        ResultsError: a file is damaged.
    """
    files = sorted((root / SIMULATED).glob("*.json"))
    remedy = "delete it and continue with --resume --simulate"
    return tuple(read_record(StoredSimulation, path, remedy) for path in files)


CONTROL: Control = "leader"


@dataclass(frozen=True)
class SimulationRequest:
    """A carry to simulate.

    Attributes:
        name: name of the file in `simulated/` to be written, without suffix.
        label: name of the carry in tables and pictures.
        trajectory: the content of the carry's trajectory file.
        digest: SHA-256 of that file.
    """

    name: str
    label: str
    trajectory: StoredTrajectory
    digest: str


def simulation_stage() -> Stage:
    """Return the stage of a study that simulates every carry of the report and writes a file in
    `simulated/` for each."""
    return Stage("simulation", _run, {"control": CONTROL})


def _run(folder: CampaignFolder, progress: Progress) -> None:
    wanted = wanted_carries(folder.root)
    (folder.root / SIMULATED).mkdir(exist_ok=True)
    kept = {one.name for one in wanted}
    for path in (folder.root / SIMULATED).glob("*.json"):
        if path.stem not in kept:
            path.unlink()
    left = [one for one in wanted if not is_done(folder.root, one)]
    with progress.stage("simulation", len(wanted), "carries", len(wanted) - len(left)) as advance:

        def answered(index: int, answer: StoredSimulation) -> None:
            # As it comes, so that what is interrupted goes on from there.
            write_json(_file(folder.root, left[index].name), to_json(answer))
            advance(1)

        folder.workers.map(_simulated, left, answered)


def _file(root: Path, name: str) -> Path:
    return root / SIMULATED / f"{name}.json"


def is_done(root: Path, one: SimulationRequest) -> bool:
    """Return True if a simulation of exactly this trajectory with the present control law is
    stored.

    Args:
        root: results folder of the study.
        one: the requested simulation.
    """
    try:
        stored = read_record(StoredSimulation, _file(root, one.name), "")
    except ResultsError:
        return False
    return stored.trajectory == one.digest and stored.controller == CONTROL


def wanted_carries(root: Path) -> list[SimulationRequest]:
    """Return the carries of a study to simulate, if their files exist in the results folder `root`.

    These are the hand-made one, the best of each algorithm, and the recommended one.
    """
    summary = read_summary(root)
    shown, places = summary.shown_files, ["", *summary.algorithms]
    files = {
        f"{places.index(name)}-{name or 'hand-made'}": (file_label(file), root / SELECTED / file)
        for name, file in shown.items()
    }
    files["9-recommended"] = ("recommended", root / RECOMMENDED_FILE)
    return [
        SimulationRequest(name, label, read_trajectory(path), sha256(read_bytes(path)))
        for name, (label, path) in files.items()
        if path.exists()
    ]


def _simulated(one: SimulationRequest) -> StoredSimulation:
    whose = (one.label, one.digest, CONTROL)
    with TemporaryDirectory() as folder:
        cell = one.trajectory.open_cell(Path(folder))
        try:
            carry = driven_carry(cell, one.trajectory.x)
            if not contact_model(cell.workcell).is_squeeze:
                return _simulated_hands(carry, *whose)
            found = simulate_carry(cell, carry, CellSimulation(cell.workcell), CONTROL)
        except (SimulationError, SettingsError) as error:
            return StoredSimulation(*whose, problem=str(error))
        return stored_simulation(found, *whose)


def _simulated_hands(
    carry: Carry, label: str, trajectory: str, controller: str
) -> StoredSimulation:
    """Simulate a carry in hands without arms, and return the record to store.

    It holds the results of two simulations: the search for the least factor on the planned forces
    that holds the payload, and one run with the forces that hold it in every case of the
    uncertainty.

    Args:
        carry: the carry.
        label: name of the carry.
        trajectory: SHA-256 of the carry's trajectory file.
        controller: name of the control law, which is only stored.
    """
    threshold, workcell = hand_threshold(carry), carry.workcell
    robust = commanded_forces(workcell, carry, SqueezeSettings(), itemised=False)[0].max(axis=0)
    motion = carriage_motion(carry, HAND_SETTINGS)
    shown = HandSimulation(workcell).simulate(motion, own_forces(workcell, robust))
    return StoredSimulation(
        label,
        trajectory,
        controller,
        problem="",
        duration=carry.duration,
        slips=threshold.slips.factor,
        holds=threshold.holds.factor,
        pad=threshold.slips.pad + 1,
        begins=float(threshold.slips.time[-1] - motion.time[0]) - HAND_SETTINGS.settle,
        robust=True,
        arrives=shown.holds,
        slip=float(shown.slip.max()),
    )


TIMING = "timing"
"""Name of the folder of timings in a results folder; its files are laid out as those of the
selected trajectories."""

CURVE_POINTS = 12
"""Number of force limits at which the trajectories that a report shows are timed."""

Request = tuple[Array, int | None]
"""A decision vector (n_var,), and the number of force limits to time it at, None for no such
curve."""


def timing_stage(curves: bool = True) -> Stage:
    """Return the stage of a study that computes the timings of the selected trajectories
    (`time_trajectory`) and writes a file in `timing/` for each.

    If the union of all fronts was polished, only the trajectory selected from the union and those
    that a report shows are timed.

    Args:
        curves: True to compute also the curve of duration against force limit for trajectories that
            a report shows.
    """

    def run(folder: CampaignFolder, progress: Progress) -> None:
        selected = folder.root / SELECTED
        files = sorted(path.relative_to(selected) for path in selected.rglob("*.json"))
        summary = read_summary(folder.root)
        shown = set(summary.shown_files.values())
        if summary.union is not None:
            union = polished_selected_file(Path(), UNION, 0).relative_to(SELECTED)
            files = [file for file in files if file in {*shown, union}]
        timed = shown if curves else set[Path]()
        requests = [
            (read_trajectory(selected / f).x, CURVE_POINTS if f in timed else None) for f in files
        ]
        driven = folder.workcell.task.law.is_drivable
        cells = cells_of(folder.files, folder.settings.objectives, driven)
        with progress.stage(TIMING, len(requests), "trajectories") as advance:
            call = partial(_document, cells)
            found = folder.workers.map(call, requests, lambda *_: advance(1))
        for file, document in zip(files, found, strict=True):
            write_json(folder.root / TIMING / file, to_json(document))

    return Stage(TIMING, run)


def _document(cells: Cells, request: Request) -> TimingDocument:
    ready = ready_cells(cells)
    own, driven = ready[0].jobs.timing, ready[-1].jobs.timing
    x, curve_points = request
    return timing_document(time_trajectory(driven, x, curve_points=curve_points, own=own))


def limits_on_jerk(root: Path, recommended: StoredRecommendation | None) -> Table | None:
    """Return a table of durations with and without the cell's limits on jerk, for the hand-made,
    the selected and the recommended carries. None if the cell limits no jerk.

    Args:
        root: results folder of the drivable experiment.
        recommended: the recommended carry; None without one.

    Raises:
        ResultsError: a timing is damaged.
    """
    found: dict[str, list[tuple[float, float]]] = {}
    for path in sorted((root / TIMING).rglob("*.json")):
        jerk = read_timing(path).jerk
        if jerk is not None and jerk.status == TimingStatus.OK:
            label = file_label(path.relative_to(root / TIMING))
            found.setdefault(label, []).append((jerk.without, jerk.duration))
    if recommended is not None and math.isfinite(recommended.without_jerk):
        found["recommended"] = [(recommended.without_jerk, recommended.duration)]
    if not found:
        return None
    rows = []
    for label, timings in found.items():
        without, within = np.array(timings).T
        cost = 100.0 * (within / without - 1.0)
        durations = (number(float(np.median(each)), 3) for each in (without, within))
        costs = (number(each, 1) for each in (float(np.median(cost)), float(cost.max())))
        rows.append((label, str(len(timings)), *durations, *costs))
    return Table(
        "jerk",
        "What limits on jerk cost the selected drivable carries and the recommended one.",
        ("limits on jerk", "carries", "without [s]", "within [s]", "cost [%]", "at most [%]"),
        tuple(rows),
        "Joints and payload within their largest jerk, at rest without acceleration at both ends. "
        "Medians over the carries. The recommended one within as in its job, in whole cycles of "
        "the controllers.",
    )


def file_label(path: Path) -> str:
    """Return the name of a trajectory for tables, such as 'NSGA-II, polished'.

    Args:
        path: path of the trajectory file, relative to the folder of selected trajectories.
    """
    if len(path.parts) == 1:
        return path.stem
    folder = path.parts[0]
    name = title(folder.removesuffix(POLISHED_SUFFIX))
    return f"{name}, polished" if folder.endswith(POLISHED_SUFFIX) else name
