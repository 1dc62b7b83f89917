"""The stage that times every selected trajectory as a robot can drive it, and its words."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

from hybrid_opt.campaign import CampaignFolder, Progress, Stage, executor_for
from hybrid_opt.campaign.cell_source import PackedCell
from hybrid_opt.campaign.layout import POLISHED_SUFFIX, SELECTED
from hybrid_opt.cell import Cell
from hybrid_opt.display.table import text_table
from hybrid_opt.store.files import write_json
from hybrid_opt.store.json_records import to_json
from hybrid_opt.store.trajectory_file import read_trajectory
from hybrid_opt.timing import ForceCurve, TimedTrajectory, Timing, TimingModel, timed_trajectory
from hybrid_opt.timing.document import TimingDocument, timing_document
from hybrid_opt.timing.robustness import KILOGRAM_FORCE, Margin
from hybrid_opt.timing.use import joint_use
from hybrid_opt.work.service import Emit, Service, answer_all
from studies.study.terminal import number
from symbolic.array import Array
from symbolic.records import Workcell
from symbolic.records.task import initial_decision

TIMING = "timing"
"""Folder of the timings in a results folder, laid out as that of the selected trajectories."""


def timing_stage(force_limit: float | None = None, last: bool = False) -> Stage:
    """The stage that writes `timing/`: one document per selected trajectory.

    Args:
        force_limit: normal force [N] of an additional, force-limited timing.
        last: whether of replicas that were polished only the polished one is timed.
    """

    def run(folder: CampaignFolder, progress: Progress) -> None:
        _run(folder, progress, force_limit, last)

    return Stage(TIMING, run, {"force_limit": force_limit})


def _run(folder: CampaignFolder, progress: Progress, force_limit: float | None, last: bool) -> None:
    selected = folder.root / SELECTED
    files = sorted(path.relative_to(selected) for path in selected.rglob("*.json"))
    if last:
        known = {str(path) for path in files}
        files = [
            path for path in files if f"{path.parent}{POLISHED_SUFFIX}/{path.name}" not in known
        ]
    found = {file: read_trajectory(selected / file).x for file in files}
    service = Service(
        TimingModelSource(PackedCell.of(folder.files), folder.settings.objectives), _document
    )
    requests = [(x, force_limit) for x in found.values()]
    with progress.stage(TIMING, len(requests), "trajectories") as advance:
        executor = executor_for(folder.execution)
        documents = answer_all(executor, service, requests, lambda: advance(1))
    for file, document in zip(found, documents, strict=True):
        write_json(folder.root / TIMING / file, to_json(document))


@dataclass(frozen=True)
class TimingModelSource:
    """Makes a workcell's timing model, in any process.

    Attributes:
        cell: the workcell.
        objectives: what is minimised, which says what force limits are about.
    """

    cell: PackedCell
    objectives: tuple[str, ...]

    def __call__(self) -> TimingModel:
        """Load the compiled functions, or build them where they are missing."""
        return self.cell.make(partial(_ready_model, self.objectives))


def _ready_model(objectives: tuple[str, ...], workcell: Workcell) -> TimingModel:
    model = Cell(workcell, objectives).timing_model
    # The cell's files are there only now: what is loaded when it is first needed is needed now.
    model.search_carry(initial_decision(workcell.task))
    return model


def _document(
    model: TimingModel, request: tuple[Array, float | None], emit: Emit
) -> TimingDocument:
    return timing_document(timed_trajectory(model, *request))


def timing_text(timed: TimedTrajectory) -> str:
    """A table of the timings, their reasons, the margins and the force curve."""
    report = timed.report
    head = ("timing", "status", "s", "N1/Nref", "N2/Nref", "payload kg", "torque %", "shift mm")
    rows = [[name, t.status.value, *_cells(t)] for name, t in report.timings.items()]
    parts = [
        f"Timing (at the reference speeds without ramps: {number(report.nominal_duration, 3)} s)\n"
        + text_table([head, *rows], left=(0, 1)),
        "\n".join(f"{name}: {timing.reason}" for name, timing in report.timings.items()),
    ]
    if report.jerk is not None:
        without, cost = report.jerk.without, 100.0 * report.jerk.cost
        parts.append(f"Limits on jerk cost {number(cost, 1)} % of {number(without, 3)} s")
    if timed.margins:
        parts.append(_margins(timed.margins))
    if timed.curve is not None:
        parts.append(_curve(timed.curve))
    return "\n\n".join(parts)


def _cells(timing: Timing) -> list[str]:
    carry = timing.carry
    if carry is None:
        return ["-"] * 6
    torque = joint_use(carry, carry.workcell)["joint torque"].max()
    return [
        number(timing.duration, 3),
        *(number(ratio, 4) for ratio in carry.force_ratio),
        number(carry.payload_limit, 2),
        number(torque, 1, 100.0),
        number(float(carry.pressure_shift.max()), 1, 1e3),
    ]


def _margins(margins: tuple[Margin, ...]) -> str:
    rows = [("quantity", "nominal", "limit", "unit", "what fails beyond it")]
    rows += [
        (m.quantity, number(m.nominal, 4), number(m.limit, 4), m.unit, m.fails or "nothing")
        for m in margins
    ]
    table = text_table(rows, left=(0, 3, 4))
    return f"Margins under the timing closest to the reference speed\n{table}"


def _curve(curve: ForceCurve) -> str:
    rows = [("N", "kgf", "s", "status")]
    rows += [
        (number(force, 2), number(force / KILOGRAM_FORCE, 2), number(duration, 3), status.value)
        for force, duration, status in zip(curve.force, curve.duration, curve.status, strict=True)
    ]
    rest = number(curve.static_force, 2)
    return f"Duration against force limit (at rest {rest} N)\n{text_table(rows, left=(3,))}"
