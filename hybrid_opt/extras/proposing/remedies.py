"""The least changes of a problem with which both arms can hold the box at start and goal: bases
moved or raised, longer tools, another height of the goal. The changes are found by trying them."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hybrid_opt.errors import ProposalError
from hybrid_opt.extras.proposing.problem import Problem
from hybrid_opt.extras.proposing.setup import prepare
from symbolic.array import Array
from symbolic.errors import WorkcellError
from symbolic.records.poses import rotation_from_rpy

AMOUNTS = (0.05, 0.10, 0.15, 0.20, 0.30, 0.40)
"""Amounts of change that are tried [m], the smallest of all kinds first."""

ENOUGH_CHANGES = 3
"""Number of kinds of changes after which the search ends."""

REMEDY_SECONDS = 30.0
"""Largest processor time of the search [s]."""

Tables = dict[str, Any]


@dataclass(frozen=True)
class ProblemChange:
    """A kind of change of a problem.

    Attributes:
        text: description of the change, with a placeholder for the amount in metres.
        change: function of a problem, a copy of its tables and an amount [m] that changes the copy.
        moves_machine: True if robots or tools change, False if the task does.
    """

    text: str
    change: Callable[[Problem, Tables, float], None]
    moves_machine: bool = True

    def applied(self, problem: Problem, amount: float) -> Problem:
        """Return a copy of a problem to which this change is applied.

        Args:
            problem: the problem.
            amount: amount of the change [m].
        """
        data = copy.deepcopy(problem.data)
        self.change(problem, data, amount)
        return replace(problem, data=data)


def _towards(problem: Problem) -> Array:
    """Compute horizontal unit vectors (2, 3) in the world from each robot's base to the middle of
    the carry.

    Both vectors are equal for a machine with two arms.

    Args:
        problem: problem whose file states the bases.
    """
    middle = np.mean(problem.poses, axis=0)[:3]
    bases = np.array([robot["base"]["xyz"] for robot in problem.data["robots"]], dtype=float)
    away = (middle - bases) * [1.0, 1.0, 0.0]
    return np.asarray(away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9))


def _move_bases(sign: float) -> Callable[[Problem, Tables, float], None]:
    def change(problem: Problem, data: Tables, amount: float) -> None:
        for robot, way in zip(data["robots"], _towards(problem), strict=True):
            moved = np.array(robot["base"]["xyz"]) + sign * amount * way
            robot["base"]["xyz"] = np.round(moved, 4).tolist()

    return change


def _raise_bases(problem: Problem, data: Tables, amount: float) -> None:
    for robot in data["robots"]:
        robot["base"]["xyz"][2] = round(robot["base"]["xyz"][2] + amount, 4)


def _lengthen_tools(problem: Problem, data: Tables, amount: float) -> None:
    """Move both pads outwards along their normals, in a copy of the problem's tables. The bodies of
    the tools stay in place.

    Args:
        problem: the problem; not used.
        data: tables of the problem file, which are changed.
        amount: displacement of the pads [m].
    """
    for robot in data["robots"]:
        pad = robot["pad"]
        normal = rotation_from_rpy(pad.get("rpy", [0.0, 0.0, 0.0]))[:, 2]
        pad["xyz"] = np.round(np.array(pad["xyz"]) + amount * normal, 4).tolist()


def _shift_goal(sign: float) -> Callable[[Problem, Tables, float], None]:
    def change(problem: Problem, data: Tables, amount: float) -> None:
        data["task"]["goal"][2] = round(data["task"]["goal"][2] + sign * amount, 4)

    return change


PROBLEM_CHANGES = (
    ProblemChange("bases {:.2f} m nearer", _move_bases(1.0)),
    ProblemChange("bases {:.2f} m farther away", _move_bases(-1.0)),
    ProblemChange("bases {:.2f} m higher", _raise_bases),
    ProblemChange("tools {:.2f} m longer", _lengthen_tools),
    ProblemChange("goal {:.2f} m lower", _shift_goal(-1.0), moves_machine=False),
    ProblemChange("goal {:.2f} m higher", _shift_goal(1.0), moves_machine=False),
)


def least_changes(
    problem: Problem,
    can_hold: Callable[[Problem], bool],
    is_over: Callable[[], bool],
    kinds: Sequence[ProblemChange] = PROBLEM_CHANGES,
    amounts: Sequence[float] = AMOUNTS,
) -> list[tuple[ProblemChange, float]]:
    """Find for each kind of change of a problem the smallest tried amount with which both arms can
    hold the box.

    The search ends when `ENOUGH_CHANGES` kinds are found, or when `is_over` returns True.

    Args:
        problem: problem whose file states the bases and the pads' positions.
        can_hold: function that returns True for a problem in which both arms can hold the box.
        is_over: function that returns True if the search has to end.
        kinds: kinds of changes that are tried, each alone.
        amounts: amounts that are tried, the smallest first [m].

    Returns:
        Kinds of changes with their amounts [m], the smallest amount first.
    """
    found: dict[ProblemChange, float] = {}
    for amount in amounts:
        for kind in kinds:
            if len(found) == ENOUGH_CHANGES or is_over():
                return list(found.items())
            if kind not in found and can_hold(kind.applied(problem, amount)):
                found[kind] = amount
    return list(found.items())


def changes_text(found: Sequence[tuple[ProblemChange, float]]) -> str:
    """Return a text that lists changes as alternatives.

    Args:
        found: kinds of changes with their amounts [m].
    """
    return ", or ".join(kind.text.format(amount) for kind, amount in found)


def states_machine(problem: Problem) -> bool:
    """Return True if a problem's file states the bases and the pads of both robots. Only then can
    changes of the problem move them.
    """
    robots = problem.data["robots"]
    return all("xyz" in robot.get("base", {}) and "xyz" in robot.get("pad", {}) for robot in robots)


def _can_hold(problem: Problem, spins: Array, rng: np.random.Generator) -> bool:
    try:
        prepare(problem, {}, spins, rng)
    except (ProposalError, WorkcellError):
        return False
    return True


def remedies_text(
    problem: Problem, spins: Array, rng: np.random.Generator, is_over: Callable[[], bool]
) -> str:
    """Return a text on the smallest changes with which both arms can hold the box.

    The text is '' if the file states no bases or no change was found.

    Args:
        problem: the problem.
        spins: (n,) rotations of the pads about their normals that are tried [rad].
        rng: generator of random postures.
        is_over: function that returns True if the search has to end.
    """
    if not states_machine(problem):
        return ""
    found = least_changes(problem, lambda changed: _can_hold(changed, spins, rng), is_over)
    return f"; both arms could hold it with {changes_text(found)}" if found else ""
