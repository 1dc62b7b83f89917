"""Redundant joints as variables against the same joints locked at constant positions."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import product
from math import ceil

import numpy as np

from hybrid_opt.cell import Cell
from hybrid_opt.display.table import counted
from hybrid_opt.evaluate.evaluation import Evaluations, LockedEvaluator
from hybrid_opt.evaluate.objectives import front_rows
from hybrid_opt.indicators.metrics import hypervolume
from hybrid_opt.metaheuristics.run import SearchSettings, search_carries
from studies.program import load_workcell
from symbolic.errors import SettingsError
from symbolic.records import Task


@dataclass(frozen=True)
class LockedReplica:
    """Hypervolumes of one replica with free and with locked redundant joints.

    Attributes:
        free: hypervolume with the redundant joints free.
        locked: hypervolume for each combination of locked positions, in the order of `locks`.
        best: positions of the combination with the largest hypervolume [rad or m].
    """

    free: float
    locked: tuple[float, ...]
    best: tuple[float, ...]


def locks(task: Task, count: int) -> tuple[tuple[float, ...], ...]:
    """Return at least `count` combinations of positions of the redundant joints [rad or m].

    The combinations are the middles of the cells of a grid over the joints' bounds.
    """
    sides = max(ceil(count ** (1.0 / len(task.redundant)) - 1e-9), 1)
    shares = (np.arange(sides) + 0.5) / sides
    values = [
        float(joint.lower.min()) + shares * float(joint.upper.max() - joint.lower.min())
        for joint in task.redundant
    ]
    return tuple(tuple(float(v) for v in entry) for entry in product(*values))


def compare(
    cell: Cell, count: int, replicas: int, evaluations: int, seed: int
) -> list[LockedReplica]:
    """Search with free and with locked redundant joints, in several replicas.

    Args:
        cell: the cell.
        count: least number of combinations of locked positions.
        replicas: number of replicas.
        evaluations: budget of each search.
        seed: seed of all searches.

    Returns:
        The hypervolumes of each replica.

    Raises:
        SettingsError: the cell has no redundant joint, or one is fixed at a waypoint.
    """
    task = cell.workcell.task
    if not task.redundant:
        raise SettingsError(
            "no joint of this cell is redundant; there is nothing to compare",
            code="nothing-redundant",
        )
    tried, found = locks(task, count), []
    for replica in range(replicas):
        start = SearchSettings(initial=cell.initial[None])
        rng = np.random.default_rng([seed, replica])
        free, _ = search_carries(cell.evaluator, "nsga2", evaluations, rng, start)
        volumes = []
        for positions in tried:
            rng = np.random.default_rng([seed, replica])
            locked = LockedEvaluator(cell.evaluator, np.array(positions))
            start = SearchSettings(initial=cell.initial[None, : task.n_box])
            done, _ = search_carries(locked, "nsga2", evaluations, rng, start)
            volumes.append(_volume(done))
        best = tried[int(np.argmax(volumes))]
        found.append(LockedReplica(_volume(free), tuple(volumes), best))
    return found


def _volume(evaluations: Evaluations) -> float:
    rows = front_rows(evaluations.objectives, evaluations.feasible)
    return float(hypervolume(evaluations.objectives[rows])) if len(rows) else 0.0


def as_text(found: Sequence[LockedReplica]) -> str:
    """Return the results of `compare` as text."""
    lines = ["replica     free  best lock  locks with a carry  at"]
    for k, one in enumerate(found):
        some = sum(volume > 0.0 for volume in one.locked)
        at = ", ".join(f"{position:.3f}" for position in one.best)
        best = max(one.locked)
        lines.append(f"{k:7d} {one.free:8.4f} {best:10.4f} {some:8d} of {len(one.locked)}  {at}")
    better = sum(one.free > max(one.locked) for one in found)
    lines.append(f"free beats the best lock in {better} of {counted(len(found), 'replica')}")
    return "\n".join(lines)


def redundancy(options: argparse.Namespace) -> int:
    """Make the comparison that the options request, and print it. Return the exit code.

    Raises:
        SettingsError: the cell has no redundant joint.
    """
    cell = Cell(load_workcell(options.workcell))
    counts = (options.locks, options.replicas, options.evaluations, options.seed)
    found = compare(cell, *counts)
    print(json.dumps([asdict(one) for one in found]) if options.json else as_text(found))
    return 0
