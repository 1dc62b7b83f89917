"""Look at a workcell before a study: what it is, what is feasible in it, what it can win.

Prints the cell's facts, the postures at the start, the static bound, the verdicts on the
hand-made trajectory and on the straight line, the feasibility of random candidates by
constraint, with the pairs, joints and robots that are in the way most, the bounds that a short
polish ends on, and the number of collision pairs (--pairs lists them with the reasons for those
left out); draws the cell, both arms' reach and the first collision of trajectories that fail;
with --view writes a page that shows the hand-made one at any sample.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

from hybrid_opt.campaign.progress import Progress
from hybrid_opt.carry import Judgement
from studies.inspection import Inspection, Optimum
from studies.inspection_branches import Branch
from studies.options import seed, whole
from studies.program import Parser, add_verbose, carried_out, load_workcell, run_program

_IN_THE_WAY = {
    "pairs": "Pairs that collide first",
    "joints": "Joints beyond a limit first",
    "reach": "Robots that do not reach first",
}
MOST_TOLD = 10
"""Most obstacles that are told."""

PROGRAM = "python -m studies.inspect"


def told(found: Inspection, pairs: bool = False) -> Iterator[str]:
    """An inspection for people, in lines that come as soon as they are known.

    Args:
        pairs: whether every pair of bodies is listed.
    """
    yield from (found.name, "")
    yield from (f"  {heading}: {text}" for heading, text in found.facts.items())
    still = ", ".join(f"{force:.2f}" for force in found.static_normal_force)
    share = ", ".join(f"{value:.4f}" for value in found.static_objectives)
    yield ""
    yield (
        f"At rest, level: normal forces {still} N, objectives {share}; payload at the reference "
        f"force {found.static_payload_limit:.2f} kg"
    )
    if found.unheld:
        yield f"Infeasible, whatever the path: {found.unheld}"
    found.build()
    yield f"Hand-made trajectory: {_judged_text(found.initial)}"
    yield from _why(found, "initial")
    yield f"Straight line: {_judged_text(found.straight_line)}"
    yield from _why(found, "straight_line")
    yield from ("", "Postures at the start, best first (* used), along the hand-made trajectory")
    for robot, branches in found.branches.items():
        yield f"  {robot}"
        yield from (f"  {'*' if b.chosen else ' '} {_branch_text(b)}" for b in branches)
    yield ""
    yield (
        f"{found.candidates} random candidates within the bounds (seed {found.seed}): "
        f"{100.0 * found.feasible_share:.1f} % feasible"
    )
    for name, count in found.infeasible_by_reason.items():
        yield f"  {name.replace('_', ' ')}: {count} ({100.0 * count / found.candidates:.1f} %)"
    for heading, title in _IN_THE_WAY.items():
        counts = list(found.in_the_way[heading].items())[:MOST_TOLD]
        if counts:
            yield from ("", f"{title}, in {found.explained_candidates} of the infeasible ones:")
            yield from (f"  {name}: {count}" for name, count in counts)
    checked, left_out = len(found.active_pairs), len(found.excluded_pairs)
    yield ""
    yield f"Collision pairs: {checked} checked, {left_out} left out" + (
        "" if pairs else " (--pairs lists them, and why)"
    )
    if pairs:
        yield from (f"  {first} – {second}" for first, second in found.active_pairs)
        yield from (f"  {first} – {second}: {why}" for first, second, why in found.excluded_pairs)
    if found.optimum is not None:
        yield from ("", *_optimum_lines(found.optimum))
    if found.files:
        yield from ("", "Pictures: " + ", ".join(found.files))
    if found.view:
        yield from ("", f"View: {found.view} (open it in a browser)")


def _why(found: Inspection, name: str) -> list[str]:
    return [f"  {found.explained[name]}"] if name in found.explained else []


def _optimum_lines(optimum: Optimum) -> list[str]:
    if optimum.problem:
        return [f"Bounds at the optimum: not known: {optimum.problem}"]
    head = f"Bounds at the optimum ({optimum.solutions} points of a short polish)"
    if not optimum.binding:
        return [f"{head}: none binds"]
    return [
        f"{head}: these bind, wider ones may allow better carries",
        *(f"  {bound}: {bound.solutions} of {optimum.solutions}" for bound in optimum.binding),
    ]


def _branch_text(branch: Branch) -> str:
    joints = " ".join(
        f"{value:7.1f}" if unit == "deg" else f"{value:7.1f} {unit}"
        for value, unit in zip(branch.joints, branch.joint_units, strict=True)
    )
    limits = ", ".join(f"{margin:.0f} {unit}" for unit, margin in branch.limit_margins.items())
    near = "unlimited" if branch.clearance_mm is None else f"{branch.clearance_mm:.1f} mm"
    if branch.clearance_mm == 0.0:
        near = "none (collides)"
    return (
        f"[{joints}] deg: keeps {branch.kept_samples} samples, clearance {near}, limits {limits}, "
        f"manipulability {branch.manipulability:.4f} m^3 (at least {branch.least_manipulability:g})"
    )


def _judged_text(judgement: Judgement) -> str:
    forces = ", ".join(f"{value:.4f}" for value in judgement.objectives.values())
    return f"{judgement}, objectives {forces}" if judgement.feasible else str(judgement)


@carried_out(PROGRAM)
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; returns the exit code."""
    parser = Parser(prog=PROGRAM, description=__doc__)
    parser.add_argument("workcell", type=Path, metavar="WORKCELL", help="the workcell file")
    parser.add_argument(
        "--candidates",
        type=whole(1, 10**7),
        default=1000,
        metavar="N",
        help="random candidates to judge (default: %(default)s)",
    )
    parser.add_argument(
        "--seed", type=seed, default=1, metavar="N", help="of their randomness (default: 1)"
    )
    parser.add_argument(
        "--output",
        type=Path,
        metavar="DIR",
        help="folder for pictures and view (default: inspect/NAME of the workcell file)",
    )
    parser.add_argument(
        "--polish",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="polish the hand-made trajectory shortly, to see which bounds bind (default: yes)",
    )
    parser.add_argument(
        "--view",
        action="store_true",
        help="write a page that plays the hand-made trajectory, from where it first fails",
    )
    parser.add_argument("--no-pictures", action="store_true", help="draw nothing")
    parser.add_argument("--pairs", action="store_true", help="list every pair of bodies")
    parser.add_argument("--json", action="store_true", help="print JSON instead of text")
    add_verbose(parser)
    options = parser.parse_args(arguments)
    output = options.output or Path("inspect") / options.workcell.stem
    found = Inspection(
        load_workcell(options.workcell),
        options.candidates,
        options.seed,
        None if options.no_pictures else output,
        options.polish,
        output / "view.html" if options.view else None,
    )
    found.progress = Progress()
    if options.json:
        found.build()
        print(json.dumps(found.document(), default=asdict, indent=2))
    else:
        for line in told(found, options.pairs):
            print(line, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(run_program(main))
