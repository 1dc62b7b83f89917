"""What the page's scripts need: trajectories, shapes and fronts as compact JSON values."""

from __future__ import annotations

from typing import Any

import numpy as np

from hybrid_opt import carry
from hybrid_opt.display.scene import packed, scene_data
from hybrid_opt.timing import TimingModel
from studies.report.records import AlgorithmRuns, DrawnCarry, Front, ReportData
from studies.report.style import series
from symbolic.array import Array

MAX_SAMPLES = 60
"""Samples of a trajectory on the page; its force peaks are kept besides."""

MAX_CLOUD = 1500
"""Feasible candidates per algorithm in the background of the fronts."""

MAX_FRONT = 150
"""Trajectories of one front on the page, spread evenly over it."""

SYMBOLS = {"o": "circle", "^": "triangle-up", "D": "diamond", "v": "triangle-down", "P": "cross"}
"""Plotly's names of Matplotlib's markers."""


class PageData:
    """Collects the trajectories that the page shows."""

    def __init__(self, data: ReportData, model: TimingModel) -> None:
        self._data = data
        self._model = model
        self._limit = np.concatenate([robot.torque_max for robot in data.workcell.robots])
        self._trajectories: list[dict[str, Any]] = []

    def document(self) -> dict[str, Any]:
        """The page's data as JSON values."""
        data = self._data
        picked = [self._add_carry(carry) for carry in data.carries]
        lists = [{"label": "Selected", "members": picked}]
        groups, clouds, shown = [], [], []
        for algorithm in data.solved:
            look = series(algorithm.index)
            run = algorithm.shown
            cloud = _thinned(run.evaluations.objectives[run.evaluations.feasible], MAX_CLOUD)
            clouds.append(
                {
                    "label": f"{algorithm.title}: feasible",
                    "points": packed(cloud[:, :2], np.float32),
                    "colour": look.colour,
                    "symbol": SYMBOLS[look.marker],
                }
            )
            for label, front, symbol in _fronts(algorithm, SYMBOLS[look.marker]):
                members = self._add_front(label, front)
                shown.append(front.objectives[:, :2])
                groups.append(
                    {"label": label, "members": members, "colour": look.colour, "symbol": symbol}
                )
                lists.append({"label": label, "members": members})
        rest = data.static[:2]
        known_rest = bool(np.isfinite(rest).all()) and len(rest) == 2
        contacts = data.workcell.contacts
        force = data.static[:2] * data.workcell.task.reference_force[: len(rest)]
        return {
            "objectiveTitles": list(data.objective_titles),
            "robots": [robot.name for robot in data.workcell.robots],
            "joints": [len(robot.torque_max) for robot in data.workcell.robots],
            "patchRadius": min(contact.patch_radius for contact in contacts),
            "rest": rest.tolist() if known_rest else None,
            "restForce": float(force.max()) if known_rest else None,
            "ranges": _ranges(shown, rest if known_rest else None),
            "first": picked[-1] if len(picked) == 1 else picked[1],
            "trajectories": self._trajectories,
            "groups": groups,
            "clouds": clouds,
            "lists": lists,
            **scene_data(data.geometry, data.carries[-1].timed),
        }

    def _add_carry(self, carry: DrawnCarry) -> int:
        label = carry.label if carry.feasible else f"{carry.label} (infeasible)"
        return self._add(label, carry.timed, carry.objectives)

    def _add_front(self, label: str, front: Front) -> list[int]:
        rows = np.unique(np.linspace(0, len(front) - 1, min(len(front), MAX_FRONT)).astype(int))
        return [
            self._add(
                f"{label}, point {row + 1}",
                self._model.search_carry(front.x[row]),
                front.objectives[row],
            )
            for row in rows.tolist()
        ]

    def _add(self, label: str, timed: carry.Carry, objectives: Array) -> int:
        self._trajectories.append(
            {
                "label": label,
                "objectives": [float(value) for value in objectives],
                "peaks": [round(float(value), 4) for value in timed.peak_normal_force],
                "duration": round(timed.duration, 5),
                "payloadLimit": round(timed.payload_limit, 4),
                "torqueUse": [
                    round(float(value), 3)
                    for value in 100.0 * np.abs(timed.contact_torque).max(axis=0) / self._limit
                ],
                "data": packed(_samples(timed), np.float32),
            }
        )
        return len(self._trajectories) - 1


def _fronts(algorithm: AlgorithmRuns, symbol: str) -> list[tuple[str, Front, str]]:
    run = algorithm.shown
    found = [(f"{algorithm.title}: search", run.front, symbol)]
    if run.hybrid is not None and len(run.hybrid):
        found[0] = (f"{algorithm.title}: search", run.front, f"{symbol}-open")
        found.append((f"{algorithm.title}: polished", run.hybrid, symbol))
    return found


def _samples(timed: carry.Carry) -> Array:
    """(k, 11 + all joints) time, pose, joints, normal forces, pressure shifts at some samples."""
    n = len(timed.time)
    peaks = [
        *timed.normal_force.argmax(axis=0),
        *timed.normal_force.argmin(axis=0),
        *timed.pressure_shift.argmax(axis=0),
    ]
    even = np.linspace(0, n - 1, min(n, MAX_SAMPLES)).round().astype(int)
    rows = np.unique(np.concatenate([even, peaks]))
    columns = [timed.time[:, None], timed.pose, timed.q, timed.normal_force, timed.pressure_shift]
    table = np.concatenate(columns, axis=1)[rows]
    table[:, 0] -= timed.time[0]
    return np.asarray(table)


def _ranges(fronts: list[Array], rest: Array | None) -> list[list[float]]:
    """Limits of both axes around the fronts and the payload at rest."""
    points = [front for front in fronts if len(front)]
    if rest is not None:
        points.append(rest[None])
    if not points:
        return [[0.0, 1.0], [0.0, 1.0]]
    every = np.concatenate(points)
    low, high = every.min(axis=0), every.max(axis=0)
    room = np.maximum(0.06 * (high - low), 1e-4)
    limits: list[list[float]] = np.stack([low - room, high + room], axis=1).tolist()
    return limits


def _thinned(points: Array, count: int) -> Array:
    if len(points) <= count:
        return points
    return np.asarray(points[np.linspace(0, len(points) - 1, count).astype(int)])
