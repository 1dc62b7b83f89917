"""An inspection of a workcell before a study; `studies.inspect` prints it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

import hybrid_opt as ho
from hybrid_opt.building import Maker, build_all
from hybrid_opt.campaign.progress import Progress
from hybrid_opt.carry import Carry, Judgement
from hybrid_opt.cell import Cell
from hybrid_opt.evaluate.evaluations import Evaluations
from hybrid_opt.evaluate.explanation import Explanation, explain, frequent
from hybrid_opt.front import Front
from hybrid_opt.indicators.metrics import BindingBound, binding_bounds
from studies.inspection_branches import Branch, branches_of
from studies.inspection_pictures import draw, show
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.records import Workcell
from symbolic.records.task import straight_line

EXPLAINED = 200
"""Most infeasible candidates that are looked at closer."""

POLISH_ATTEMPTS = 10
"""Solves of the short polish: the trajectory itself, then ends, middle and gaps of what it
becomes."""


@dataclass(frozen=True)
class Optimum:
    """Outcome of a short polish of the hand-made trajectory.

    Attributes:
        solutions: of the polished front.
        binding: the bounds that they lie on.
        problem: why there is no polish, '' where there is one.
    """

    solutions: int
    binding: tuple[BindingBound, ...]
    problem: str = ""


class Inspection:
    """What there is to know of a cell; each part is worked out when it is first asked for.

    Attributes:
        candidates: random candidates to judge.
        seed: of their randomness.
        progress: where to show what takes long; nowhere unless another one is set.
    """

    def __init__(
        self,
        workcell: Workcell,
        candidates: int,
        seed: int,
        output: Path | None,
        polish: bool = False,
        view: Path | None = None,
    ) -> None:
        """Nothing is worked out yet.

        Args:
            workcell: the cell.
            candidates: random ones to judge, at least 1.
            seed: of their randomness.
            output: folder for the pictures, None to draw none.
            polish: whether to polish the hand-made trajectory shortly, to see which bounds bind.
            view: file for a page that shows the hand-made trajectory, None for none.

        Raises:
            SettingsError: no candidates.
        """
        if candidates < 1:
            raise SettingsError(f"--candidates is {candidates}; at least 1 is needed")
        self.candidates, self.seed = candidates, seed
        self._cell, self._output, self._polish, self._view = Cell(workcell), output, polish, view
        self.progress = Progress(shown=False)

    @property
    def name(self) -> str:
        """Of the workcell."""
        return self._cell.workcell.name

    @property
    def facts(self) -> dict[str, str]:
        """What is in the file, by heading."""
        return _facts(self._cell.workcell)

    def build(self) -> None:
        """Compile what is not compiled yet; what cannot be is told by who needs it."""
        makers: list[Maker] = [lambda: self._cell.evaluator]
        if self._polish:
            makers.append(lambda: self._cell.polish_functions)
        build_all(makers, self.progress)

    @cached_property
    def branches(self) -> dict[str, tuple[Branch, ...]]:
        """Per robot's name its postures at the start, best first."""
        robots = self._cell.workcell.robots
        return {robot.name: branches_of(self._cell, i) for i, robot in enumerate(robots)}

    @property
    def static_normal_force(self) -> tuple[float, ...]:
        """Of both robots, the level payload at rest [N]."""
        return tuple(self._cell.static_hold.normal_force.tolist())

    @property
    def static_objectives(self) -> tuple[float, ...]:
        """The same over the reference forces."""
        force = self._cell.static_hold.normal_force
        return tuple((force / self._cell.workcell.task.reference_force).tolist())

    @property
    def static_payload_limit(self) -> float:
        """Payload that reaches the reference force at rest [kg]."""
        return self._cell.static_hold.payload_limit

    @property
    def unheld(self) -> str:
        """Why the payload cannot be held still, and what would do; '' where it can."""
        return self._cell.unheld

    @property
    def initial(self) -> Judgement:
        """The verdict on the hand-made trajectory."""
        return _judged(self._carries["initial"])

    @property
    def straight_line(self) -> Judgement:
        """The verdict on the straight line."""
        return _judged(self._carries["straight_line"])

    @cached_property
    def _carries(self) -> dict[str, Carry]:
        line = straight_line(self._cell.workcell.task)
        return {
            "initial": self._cell.carry(self._cell.initial),
            "straight_line": self._cell.carry(line),
        }

    @cached_property
    def _explained(self) -> dict[str, Explanation]:
        """What is in the way of those that fail, by their names."""
        found = {}
        for name, carry in self._carries.items():
            for explanation in explain(self._cell.evaluator, self._cell.evaluate(carry.x)):
                found[name] = explanation
        return found

    @property
    def explained(self) -> dict[str, str]:
        """By 'initial' and 'straight_line' what is in the way of them, where they fail."""
        return {name: str(why) for name, why in self._explained.items()}

    @cached_property
    def _found(self) -> Evaluations:
        rng = np.random.default_rng(self.seed)
        return self._cell.evaluate(self._cell.random(self.candidates, rng))

    @property
    def feasible_share(self) -> float:
        """Of the random candidates."""
        return float(self._found.feasible.mean())

    @property
    def infeasible_by_reason(self) -> dict[str, int]:
        """Of them, by the constraint violated first."""
        return self._found.infeasible_by_reason

    @property
    def _failed(self) -> Evaluations:
        return self._found[~self._found.feasible][:EXPLAINED]

    @property
    def explained_candidates(self) -> int:
        """Infeasible ones of them that were looked at closer."""
        return len(self._failed)

    @cached_property
    def in_the_way(self) -> dict[str, dict[str, int]]:
        """Of these, how often each pair of bodies, joint and robot is in the way first."""
        return frequent(explain(self._cell.evaluator, self._failed))

    @cached_property
    def optimum(self) -> Optimum | None:
        """A short polish, None where none was asked for."""
        return _optimum(self._cell, self.progress) if self._polish else None

    @property
    def active_pairs(self) -> tuple[tuple[str, str], ...]:
        """Pairs of bodies that are checked."""
        return self._cell.geometry.pair_names

    @property
    def excluded_pairs(self) -> tuple[tuple[str, str, str], ...]:
        """Pairs that are not, and why."""
        geometry = self._cell.geometry
        names = [body.name for body in geometry.bodies]
        return tuple((names[p.first], names[p.second], p.reason) for p in geometry.excluded)

    @cached_property
    def files(self) -> tuple[str, ...]:
        """Pictures written.

        Raises:
            SettingsError: the folder cannot be made.
        """
        if self._output is None:
            return ()
        self.progress.note("drawing pictures (--no-pictures leaves them out)")
        return draw(self._cell, self._carries, self._explained, self._output)

    @cached_property
    def view(self) -> str:
        """The page that shows the hand-made trajectory, '' where none was asked for.

        Raises:
            DualArmError: it cannot be written.
        """
        if self._view is None:
            return ""
        return show(self._carries["initial"], self._explained.get("initial"), self._view)

    def document(self) -> dict[str, Any]:
        """All of it as JSON values; records are left to `dataclasses.asdict`."""
        public = [name for name, part in vars(Inspection).items() if _is_part(name, part)]
        return {name: getattr(self, name) for name in ("candidates", "seed", *public)}


def _is_part(name: str, part: object) -> bool:
    return isinstance(part, property | cached_property) and not name.startswith("_")


def _judged(carry: Carry) -> Judgement:
    assert carry.judgement is not None, "carries of a cell are judged"
    return carry.judgement


def _optimum(cell: Cell, progress: Progress) -> Optimum:
    """A short polish of the hand-made trajectory, and the bounds that bind where it ends."""
    verdicts = cell.evaluate(cell.initial)
    if not verdicts.feasible.all():
        return Optimum(0, (), "the hand-made trajectory, its start, is infeasible")
    progress.note("polishing the hand-made trajectory shortly (--no-polish leaves it out)")
    try:
        with progress.stage("short polish", POLISH_ATTEMPTS, "attempts") as advance:
            front = ho.polish(
                cell,
                Front.of_search(cell, "hand-made", verdicts),
                rng=np.random.default_rng(0),
                settings=ho.PolishSettings(attempts=POLISH_ATTEMPTS),
                told=lambda outcome: advance(1),
            )
    except SettingsError as error:
        return Optimum(0, (), str(error))
    return Optimum(len(front), binding_bounds(cell.workcell.task, front.x))


def _facts(workcell: Workcell) -> dict[str, str]:
    task, payload = workcell.task, workcell.payload
    facts = {
        f"robot {robot.name}": f"{robot.urdf.name}, base at {_vector(robot.T_world_base[:3, 3])} m"
        for robot in workcell.robots
    }
    facts["payload"] = (
        f"{payload.mass:g} kg, {_vector(payload.size)} m, centre of mass at "
        f"{_vector(payload.centre_of_mass)} m"
    )
    friction = ", ".join(f"{contact.friction:g}" for contact in workcell.contacts)
    radius = ", ".join(f"{1e3 * contact.patch_radius:g}" for contact in workcell.contacts)
    facts["contacts"] = f"friction {friction}, patch radius {radius} mm"
    facts["task"] = (
        f"{len(task.waypoints)} poses, {len(task.free_indices)} of them free ({task.n_var} "
        f"variables), {task.samples} samples, time law {task.time_law}, "
        f"{task.reference_speed:g} m/s"
    )
    facts["environment"] = ", ".join(body.name for body in workcell.environment) or "empty"
    return facts


def _vector(values: Array) -> str:
    return "(" + ", ".join(f"{value:g}" for value in values) + ")"
