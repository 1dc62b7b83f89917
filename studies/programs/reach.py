"""Where both arms of a cell can hold the box at once, for `studies.inspect --reach`."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from hybrid_opt.display.table import Table, counted, number
from hybrid_opt.extras.proposing.hold_map import (
    HeldPose,
    HoldMap,
    HoldMapSettings,
    hold_map,
    holds_anywhere,
)
from hybrid_opt.extras.proposing.hold_search import PoseState
from hybrid_opt.extras.proposing.problem import Problem, read_problem
from hybrid_opt.extras.proposing.proposal import SPINS, worked
from hybrid_opt.extras.proposing.remedies import (
    AMOUNTS,
    PROBLEM_CHANGES,
    REMEDY_SECONDS,
    ProblemChange,
    changes_text,
    least_changes,
    states_machine,
)
from hybrid_opt.progress import Progress, as_callback
from studies.program import ProgramResult, print_findings
from symbolic.array import Array
from symbolic.errors import DualArmError

REACH_AMOUNTS = (*AMOUNTS, 0.6, 0.8, 1.0)
"""Amounts of change that are tried if nothing holds anywhere [m]."""

PICTURE = "holds"
"""Name of the picture, without suffix."""


def reached(
    problem: Problem,
    settings: HoldMapSettings,
    seed: int,
    output: Path | None = None,
    progress: Progress | None = None,
) -> Iterator[ProgramResult]:
    """Yield the findings on where both arms can hold the box: a map of box poses, the best pose,
    and the picture. If no pose can be held, yield instead of the best pose what prevents it, and
    the least changes of the cell that allow one.

    Args:
        problem: the problem, with the bases of both robots.
        settings: grid of the map.
        seed: seed of the random postures.
        output: folder for the picture; None to draw none.
        progress: receives messages on the progress; None for none.

    Raises:
        DualArmError: the problem is wrong, or the picture cannot be written.
    """
    progress = progress or Progress(shown=False)
    spins = 2.0 * np.pi * np.arange(SPINS) / SPINS
    with progress.stage("places of the box", 1, "steps") as advance:
        rng = np.random.default_rng(seed)
        found = hold_map(problem, spins, rng, settings, as_callback(advance))
    yield _heights(found)
    best = found.best()
    if best is None:
        progress.note("looking for the least change with which both arms hold the box")
        yield _nowhere(problem, found, spins, seed)
    else:
        yield _best(found, best)
    files: tuple[str, ...] = ()
    if output is not None:
        files = draw(found, output)
    yield ProgramResult({"files": files}, ("", "Picture: " + ", ".join(files)) if files else ())


def _heights(found: HoldMap) -> ProgramResult:
    """Return a table with a row for each height: the share of the grid's positions at which both
    arms can hold the box, and the best pose.
    """
    places, rows, values = found.directions[0].size, [], []
    for level, height in enumerate(found.z):
        some = int((found.directions[level] > 0).sum())
        every = int((found.directions[level] == len(found.yaws)).sum())
        best = found.best(level)
        rows.append(
            (
                number(float(height), 2),
                number(some / places, 0, 100.0),
                number(every / places, 0, 100.0),
                number(some * found.step**2, 2),
                "–" if best is None else _pose_text(best.pose),
            )
        )
        values.append(
            {
                "height": float(height),
                "places": some,
                "places_in_every_direction": every,
                "best": None if best is None else best.pose.tolist(),
            }
        )
    header = (
        "height [m]",
        "holds [%]",
        "in every direction [%]",
        "area [m²]",
        "best pose [m, rad]",
    )
    turns = ", ".join(f"{angle:.0f}" for angle in np.degrees(found.yaws))
    note = (
        f"Of {places} places {found.step:g} m apart at each height of the box centre; directions: "
        f"turned by {turns} deg about the vertical; {counted(len(found.ways), 'way')} to hold it."
    )
    name = found.geometry.workcell.name
    table = Table("reach", f"{name}: where both arms can hold the box", header, tuple(rows), note)
    grid = {"step": found.step, "places": places, "yaws": found.yaws.tolist()}
    return ProgramResult({"name": name, **grid, "heights": values}, (table.text(),))


def _best(found: HoldMap, best: HeldPose) -> ProgramResult:
    """Return the best box pose and the contacts that hold it, in the form of a workcell file."""
    robots = found.geometry.workcell.robots
    held = " and ".join(
        f"{robot.name} at {_pose_text(np.array(contact['xyz']))} m of the box"
        for robot, contact in zip(robots, best.contacts, strict=True)
    )
    lines = (
        "",
        f"Best place, with {100.0 * best.comfort:.0f} % comfort (0: at a joint limit, singular)",
        f"  held by {held}",
        f"  start = {_pose_text(best.pose)}",
    )
    values: dict[str, Any] = {
        "start": best.pose.tolist(),
        "contacts": [contact["xyz"] for contact in best.contacts],
        "comfort": best.comfort,
    }
    return ProgramResult(values, lines)


def _pose_text(pose: Array) -> str:
    return "[" + ", ".join(f"{value:.4f}".rstrip("0").rstrip(".") for value in pose + 0.0) + "]"


def _nowhere(problem: Problem, found: HoldMap, spins: Array, seed: int) -> ProgramResult:
    """Return why both arms can hold the box at no pose of the map, and the least changes of the
    cell that allow it.

    Args:
        problem: the problem.
        found: the map, on which no pose can be held.
        spins: rotations of a pad about its normal to try [rad].
        seed: seed of the random postures.
    """
    state, reasons = found.state, []
    for kind, text in (
        (PoseState.OUT_OF_REACH, "an arm has no posture within its limits that reaches"),
        (PoseState.COLLIDES, "both arms reach, but collide"),
        (PoseState.MEETS_SCENE, "the box itself collides"),
    ):
        share = float((state == kind).mean())
        reasons += [f"{text}: {100.0 * share:.0f} %"] if share else []
    lines = ["", f"Both arms can hold the box nowhere. Of the poses tried: {'; '.join(reasons)}."]
    changes = _least_changes(problem, spins, seed)
    if changes:
        lines.append(f"Both could hold it with {changes}.")
    elif changes is not None:
        tried = ", ".join(kind.text.format(REACH_AMOUNTS[-1]) for kind in _kinds())
        lines.append(f"No single change helps, up to {tried}, as far as there was time to try.")
    return ProgramResult({"start": None, "changes": changes}, tuple(lines))


def _kinds() -> list[ProblemChange]:
    return [kind for kind in PROBLEM_CHANGES if kind.moves_machine]


def _least_changes(problem: Problem, spins: Array, seed: int) -> str | None:
    """Return text on the least changes of bases and tools with which both arms can hold the box at
    some pose: '' if no tried change is enough, None if the file states neither bases nor tools.

    Args:
        problem: the problem.
        spins: rotations of a pad about its normal to try [rad].
        seed: seed of the random postures.
    """
    if not states_machine(problem):
        return None
    last = worked() + REMEDY_SECONDS

    def can_hold(changed: Problem) -> bool:
        try:
            return holds_anywhere(changed, spins, np.random.default_rng(seed))
        except DualArmError:
            return False

    found = least_changes(problem, can_hold, lambda: worked() > last, _kinds(), REACH_AMOUNTS)
    return changes_text(found)


def draw(found: HoldMap, output: Path) -> tuple[str, ...]:
    """Draw a map into a folder. Return the names of the files.

    Raises:
        SettingsError: the folder cannot be made.
    """
    # Not imported at the top: without a picture nothing of it is needed.
    from studies.programs.inspection import make_folder
    from studies.report.drawing import in_style, save, settled
    from studies.report.pictures_reach import holdable_positions

    make_folder(output)
    with in_style():
        figure = settled(holdable_positions(found))
    return tuple(str(path) for path in save(figure, output, PICTURE, pdf=False))


def inspect_reach(options: argparse.Namespace) -> int:
    """Find where both arms can hold the box of the file in the options, print it, and draw it.
    Return the exit code.

    Raises:
        DualArmError: the file is wrong, or the picture cannot be written.
    """
    yaws = options.yaws or HoldMapSettings.yaws
    settings = HoldMapSettings(options.step, options.heights, yaws)
    findings = reached(
        read_problem(options.workcell, with_poses=False),
        settings,
        options.seed,
        None if options.no_pictures else options.output,
        Progress(),
    )
    print_findings(findings, options.json)
    return 0
