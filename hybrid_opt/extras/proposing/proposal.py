"""A complete workcell with a first carry, from robots, payload, start, goal and environment alone.

The steps: compare the holds of both arms (spins of the pads, postures) and rank pairs of holds;
search a free path of the box with both arms over the closed chain; fit the fewest via-points whose
spline is free; evaluate this carry, and random candidates around it until the bounds contain the
wanted share of feasible ones. The written values are evaluated again as the file states them.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from itertools import islice
from math import ceil
from pathlib import Path
from typing import Any

import numpy as np

from hybrid_opt.carry import Judgement
from hybrid_opt.display import table
from hybrid_opt.errors import NoHoldError, ProposalError
from hybrid_opt.extras.proposing.bases import base_choices
from hybrid_opt.extras.proposing.bounds import Bounds, Sampling
from hybrid_opt.extras.proposing.closed_chain import ChainConfiguration
from hybrid_opt.extras.proposing.draft import Draft, changes, decision_bounds
from hybrid_opt.extras.proposing.planner import Corridor, plan, search_subspace, straight_paths
from hybrid_opt.extras.proposing.problem import Problem, read_problem
from hybrid_opt.extras.proposing.remedies import REMEDY_SECONDS, remedies_text
from hybrid_opt.extras.proposing.setup import Pair, Setup, no_path, prepare
from hybrid_opt.extras.proposing.trial import (
    BranchLostError,
    PayloadSceneChecker,
    Trial,
    grasp_blocked,
)
from hybrid_opt.extras.proposing.via_points import (
    LEAST_SAMPLES,
    MOST_VIA_POINTS,
    along,
    fit,
    path_length,
    remove_corners,
    shorten_spline,
)
from hybrid_opt.progress import ShowProgress, as_callback, progress_bar
from symbolic.array import Array
from symbolic.cell_model import CellBodies, build_cell_bodies
from symbolic.errors import SettingsError, WorkcellError
from symbolic.path.spline import path_basis
from symbolic.records import POSE_SIZE, Workcell

SEARCH_ROUNDS = ((0, 12, 0), (2000, 12, 3), (8000, 6, 6), (30000, 16, 6), (100000, 24, 6))
"""Rounds of the search, short ones first: number of configurations that the planner may check for a
path (0 for straight motions alone), number of pairs of holds, and number of `STRAYS`."""

RESTARTS = 3
"""Number of repetitions of the last round, with other random numbers, while no carry is found and
time is left."""

OTHER_FACES = 30000
"""From this number of configurations per path on, other faces of the box are tried too, if both
arms can hold it by the faces toward them."""

STRAYS = (
    Corridor(0.0, 0.15, 0.8),
    Corridor(0.3, 0.15, 0.15),
    Corridor(0.3, 0.15, 0.8),
    Corridor(0.0, 0.15, 0.3),
    Corridor(0.3, 0.15, 0.3),
    Corridor(0.0, 0.05, 0.3),
)
"""Corridors within which paths are searched. A gap that lies in a narrower corridor is found
sooner."""

SIDES = ((0, 0, 1), (0, 1, 0), (0, -1, 0), (1, 0, 0), (-1, 0, 0))
"""Directions of deviation, one at a time, in which further classes are searched."""

FEW = 3
"""Carries with at most so many via-points are accepted at once. If a path needs more, others are
tried first."""

LONG_TRIED = 2
"""Largest number of paths with more via-points that are evaluated."""

LONGER = 2.5
"""Factor on a time that was too short, for the time that a message suggests."""

MOST_CLASSES = 100

PLANNING = 0.7
"""Share of the time after which no further path is searched."""

SPINS = 12
"""Number of spins of a pad that are tried."""

STAND_OFFS = (0.04, 0.03, 0.02, 0.01)
"""Stand-offs of the pads that are tried if the usual one is blocked [m]."""


def worked() -> float:
    """Return the processor time of this process and its children so far [s]."""
    spent = os.times()
    return spent.user + spent.system + spent.children_user + spent.children_system


@dataclass(frozen=True)
class ProposeSettings:
    """Settings of the search for a carry.

    Attributes:
        seconds: time for the whole search [s].
        feasible: smallest and largest wanted share of feasible candidates within the bounds.
        bases: True to propose the robots' bases too; the file then states their heights only.
        classes: number of carries to find that pass obstacles on different sides or start in other
            postures, if time allows.
        remedies: True to search, if the box cannot be held, for the smallest changes of the cell
            with which it can.
        clock: function that returns seconds of work; by default the processor time, which does not
            count other programs.
        used: seconds spent before the search, for example by the start of a program.
    """

    seconds: float = 120.0
    feasible: tuple[float, float] = (0.02, 0.20)
    bases: bool = False
    classes: int = 1
    remedies: bool = True
    clock: Callable[[], float] = worked
    used: float = 0.0

    def __post_init__(self) -> None:
        if not 1.0 <= self.seconds <= 1e6:
            raise SettingsError(f"seconds: found {self.seconds:g}; allowed is 1 to 1e6")
        if not 1 <= self.classes <= MOST_CLASSES:
            raise SettingsError(f"classes: found {self.classes}; allowed is 1 to {MOST_CLASSES}")
        low, high = self.feasible
        if not 0.0 < low < high <= 1.0:
            raise SettingsError(
                f"feasible: found {low:g} and {high:g}; allowed are shares 0 < least < largest <= 1"
            )


@dataclass(frozen=True)
class Proposal:
    """A workcell with a certified carry.

    Attributes:
        problem: the problem.
        found: the proposed values of the workcell.
        judgement: verdict of the evaluator, the program's check of a carry. The carry is feasible
            between its samples too.
        feasible_share: share of feasible candidates among random ones within the bounds.
        candidates: number of candidates with which this share was measured.
        seconds: time of the proposal [s].
        certified: time until the first carry was certified, before the search for bounds [s].
        q: joints (n, joints) of each arm at the task's samples [rad or m].
        sides: for each obstacle of a straight motion the side on which the carry passes it, such as
            'over post'.
        blocked: obstacle of the pads' approach or retreat; '' if there is none or no time was left
            to check.
    """

    problem: Problem
    found: Draft
    judgement: Judgement
    feasible_share: float
    candidates: int
    seconds: float
    certified: float
    q: tuple[Array, Array]
    sides: tuple[str, ...]
    blocked: str = ""

    @property
    def length(self) -> float:
        """Euclidean length of the carry's path in the joint space of both arms [rad]."""
        return path_length(np.hstack(self.q))

    @property
    def passes(self) -> str:
        """Text that names the obstacles of the straight motion from start to goal, and the side on
        which the carry passes each of them; 'nothing' if there are none. Bodies that the box
        touches at the start or goal, such as its support, do not count.
        """
        return " and ".join(self.sides) or "nothing"

    def text(self, folder: Path) -> str:
        """Return the problem file with the proposed values filled in: the text of a workcell file.

        Args:
            folder: folder to which paths in the text are relative.

        Raises:
            SettingsError: the problem file is written in a way that cannot be edited.
        """
        return self.problem.completed(changes(self.problem, self.found), folder)

    def __str__(self) -> str:
        forces = ", ".join(f"{value:.4f}" for value in self.judgement.objectives.values())
        spins = " and ".join(f"{np.degrees(spin):.0f}" for spin in self.found.spins)
        where = f" {self.passes}," if self.sides else ""
        return (
            f"a carry{where} through {table.counted(len(self.found.via), 'via-point')}, joints go "
            f"{self.length:.2f} rad, certified; objectives {forces}; "
            f"spins {spins} deg, start branches {self.found.branches[0]} and "
            f"{self.found.branches[1]}; {100.0 * self.feasible_share:.1f} % of "
            f"{self.candidates} random candidates feasible; {self.seconds:.1f} s"
            + (
                f"; stand-off {1e3 * self.found.stand_off:.0f} mm"
                if self.found.stand_off is not None
                else ""
            )
            + (f"; no whole job yet: {self.blocked}" if self.blocked else "")
        )


def propose(
    path: str | Path,
    *,
    rng: np.random.Generator,
    settings: ProposeSettings | None = None,
    tell: Callable[[str], None] = lambda text: None,
    progress: ShowProgress = False,
) -> Proposal:
    """Propose a complete workcell, with a first carry, for a problem file.

    If the settings ask for several classes of carries, which pass obstacles on different sides or
    start in other postures, the carry with the shortest joint paths is returned.

    Args:
        path: a problem file (docs/tutorials/two-robots.md).
        rng: generator of all random numbers. The same state gives the same proposal unless time
            runs out.
        settings: settings of the search; None for the defaults.
        tell: function that is called with a text on the current step.
        progress: True for a progress bar, or a function that is called with the seconds worked and
            the seconds allowed.

    Raises:
        WorkcellError: the file is wrong.
        ProposalError: no carry was found; the message names the obstacle.
    """
    return propose_classes(path, rng=rng, settings=settings, tell=tell, progress=progress)[0]


def propose_classes(
    path: str | Path,
    *,
    rng: np.random.Generator,
    settings: ProposeSettings | None = None,
    tell: Callable[[str], None] = lambda text: None,
    progress: ShowProgress = False,
) -> list[Proposal]:
    """Propose complete workcells for a problem file, whose carries pass obstacles on different
    sides or start in other postures.

    Args:
        path: a problem file (docs/tutorials/two-robots.md).
        rng: generator of all random numbers. The same state gives the same proposals unless time
            runs out.
        settings: settings of the search, with the number of carries in `classes`; None for the
            defaults, one carry.
        tell: function that is called with a text on the current step.
        progress: True for a progress bar, or a function that is called with the seconds worked and
            the seconds allowed. Most proposals need only a part of the allowed time.

    Returns:
        The proposals; the one with the shortest joint paths comes first.

    Raises:
        WorkcellError: the file is wrong.
        ProposalError: no carry was found; the message names the obstacle.
    """
    settings = settings or ProposeSettings()
    with progress_bar(progress, "seconds of work", ceil(settings.seconds)) as advance:
        search = _Search(read_problem(path), rng, settings, tell, as_callback(advance))
        return sorted(search.run(), key=lambda one: one.length)


@dataclass
class _Lazy:
    """A choice of bases, `given` as keys of the problem file, prepared at its first use."""

    given: dict[str, Any]
    spins: Array
    setup: Setup | None = None
    problem: str = ""


@dataclass
class _Search:
    """The state of one search for proposals: settings, refused paths, and the classes found."""

    problem: Problem
    rng: np.random.Generator
    settings: ProposeSettings
    tell: Callable[[str], None]
    count: Callable[[int, int], None]
    begun: float = 0.0
    refusals: list[str] = field(default_factory=list)
    known: set[tuple[int, tuple[str, ...]]] = field(default_factory=set)
    """Classes that were found: identity of the pair of holds, and the sides passed."""

    @property
    def spent(self) -> float:
        """Time used so far [s]."""
        return self.settings.used + self.settings.clock() - self.begun

    @property
    def out_of_time(self) -> bool:
        """True if no time is left."""
        return self.spent > self.settings.seconds

    @property
    def too_late(self) -> bool:
        """True if the share `PLANNING` of the allowed time is over. The rest is for the evaluation
        of paths and the search for bounds, and no further path is planned.
        """
        return self.spent > PLANNING * self.settings.seconds

    def _say(self, text: str) -> None:
        self.tell(text)
        limit = ceil(self.settings.seconds)
        self.count(min(int(self.spent), limit), limit)

    def run(self) -> list[Proposal]:
        self.begun = self.settings.clock()
        self._say("bases" if self.settings.bases else "ways to hold the box")
        spins = 2.0 * np.pi * np.arange(SPINS) / SPINS
        choices: list[dict[str, Any]] = [{}]
        if self.settings.bases:
            choices = base_choices(self.problem, spins, self.rng)
        else:
            choices += [{"contacts": pair} for pair in self.problem.other_contacts()]
        setups = [_Lazy(given, spins) for given in choices]
        found: list[Proposal] = []
        rounds = [*SEARCH_ROUNDS, *RESTARTS * SEARCH_ROUNDS[-1:]]
        for number, (effort, most, strays) in enumerate(rounds):
            if number >= len(SEARCH_ROUNDS) and (found or self.too_late):
                break
            for setup in setups:
                for one in self._round(setup, effort, most, strays):
                    found.append(one)
                    self._say(f"carry {len(found)} passes {one.passes}")
                    if len(found) == self.settings.classes:
                        return found
                if self.too_late or (setup.setup and not self._takes_all(effort)):
                    break
        if not found:
            raise self._failed(setups)
        return found

    def _takes_all(self, effort: int) -> bool:
        return self.settings.bases or effort >= OTHER_FACES

    def _round(self, lazy: _Lazy, effort: int, most: int, strays: int) -> Iterator[Proposal]:
        """Yield the carries found in one round of the search with one choice of bases.

        Args:
            lazy: the choice of bases.
            effort: largest number of configurations that a planner may check; 0 for straight paths.
            most: largest number of tried pairs of holds, the postures of both arms at both ends.
            strays: number of tried entries of `STRAYS`, allowed deviations from a straight path.
        """
        if lazy.setup is None and not lazy.problem:
            self._say("ways to hold the box")
            try:
                lazy.setup = prepare(self.problem, lazy.given, lazy.spins, self.rng, self._say)
            except NoHoldError as error:
                # Neither other holds nor other bases free the payload.
                raise NoHoldError(f"{self._without_carry}: {error}") from error
            except (ProposalError, WorkcellError) as error:
                if isinstance(error, WorkcellError) and not lazy.given:
                    raise  # the file is wrong, not the bases that were tried
                lazy.problem = str(error)
        if lazy.setup is None:
            return
        box = PayloadSceneChecker(lazy.setup.workcell)
        for number, pair in enumerate(lazy.setup.pairs[:most]):
            if self.too_late:
                break
            self._say(f"paths of pair {number + 1} of {len(lazy.setup.pairs)}")
            long: list[Array] = []
            for corners in self._paths(lazy.setup, pair, effort, strays, box):
                if corners is None or self._is_known(pair, box, along(corners)):
                    continue
                via = self._via_points(pair, corners)
                if via is None:
                    continue
                if len(via) > FEW:  # another path may do with fewer
                    long.append(via)
                    continue
                yield from self._judged(lazy.setup, pair, via, box)
            for via in sorted(long, key=len)[: LONG_TRIED + self.settings.classes - 1]:
                if not self.out_of_time:
                    yield from self._judged(lazy.setup, pair, via, box)

    def _is_known(self, pair: Pair, box: PayloadSceneChecker, path: Array) -> bool:
        """Return True if a carry of the same class was found before: with the same holds, and past
        the obstacles on the same sides.

        Args:
            pair: the holds of both arms.
            box: collision checker of the box, which names the passed sides.
            path: (n, 6) box poses of the carry [m, rad].
        """
        return bool(self.known) and (id(pair), box.sides_passed(path)) in self.known

    @property
    def _without_carry(self) -> str:
        return f"{self.problem.source}: no carry found in {self.spent:.0f} s"

    def _failed(self, setups: list[_Lazy]) -> ProposalError:
        begin = self._without_carry
        if not setups:
            return ProposalError(
                f"{begin}: no bases from which both arms follow the box were found"
            )
        tried = next((lazy for lazy in setups if lazy.setup is not None), setups[0])
        if tried.setup is None and tried.problem:
            more = len(setups) > 1 and not self.settings.bases
            others = "; nor can it be held by any other pair of faces" if more else ""
            return NoHoldError(f"{begin}: {tried.problem}{others}{self._remedies(tried.spins)}")
        met = "" if tried.setup is None else no_path(tried.setup.pairs, self.refusals)
        if self.too_late:
            longer = f"{LONGER * self.settings.seconds:.0f}"
            begin = f"{begin}, when it was out of time; try {longer} s (--time {longer})"
        text = f"{begin}: {met or 'no path was tried yet'}"
        return ProposalError(text, code="out-of-time" if self.too_late else "no-path")

    def _remedies(self, spins: Array) -> str:
        if self.settings.bases or not self.settings.remedies:
            return ""
        self._say("the least change with which the box can be held")
        last = min(self.settings.seconds, self.spent + REMEDY_SECONDS)
        return remedies_text(self.problem, spins, self.rng, lambda: self.spent > last)

    def _paths(
        self, setup: Setup, pair: Pair, effort: int, strays: int, box: PayloadSceneChecker
    ) -> Iterator[list[ChainConfiguration] | None]:
        """Yield the corners of collision-free paths of the box from start to goal.

        With `effort` 0 these are paths of three straight motions. Otherwise a planner runs once for
        each allowed deviation from the straight path; a run that finds no path yields None.

        Args:
            setup: the cell with its placed robots.
            pair: how both arms hold the box at the start and at the goal.
            effort: number of configurations that a planner may check; 0 for straight paths only.
            strays: number of tried entries of `STRAYS`, allowed deviations from a straight path.
            box: collision checker of the box.
        """
        if not effort:
            found = straight_paths(pair.chain, pair.retreats, box)
            yield from islice(found, None if self.settings.classes > 1 else 1)
            return
        limits = [(joint.lower.min(), joint.upper.max()) for joint in setup.workcell.task.redundant]
        sided = [replace(STRAYS[0], towards=side) for side in SIDES]
        for stray in (*STRAYS[:strays], *(sided if self.settings.classes > 1 else ())):
            if self.too_late:
                return
            ends = pair.start.extended, pair.goal.extended
            room = search_subspace(*ends, stray, np.array(limits).reshape(-1, 2))
            yield plan(
                pair.chain,
                pair.retreats,
                room,
                most=effort,
                out_of_time=lambda: self.too_late,
                rng=self.rng,
            )

    def _via_points(self, pair: Pair, corners: list[ChainConfiguration]) -> Array | None:
        """Find a collision-free spline from start to goal that replaces a path with corners, with
        as few via-points as possible.

        Args:
            pair: how both arms hold the box at the start and at the goal.
            corners: configurations at the corners of the collision-free path.

        Returns:
            The via-points (k, 6 + m), box poses [m, rad] and m redundant joints [rad or m]; None if
            none were found.
        """
        self._say("via-points")
        dense = remove_corners(pair.chain, corners, self.rng)
        for count in range(1, MOST_VIA_POINTS + 1):
            via = fit(pair.chain, dense, count, self.rng)
            if via is not None or self.too_late:
                return via
        return None

    def _judged(
        self, setup: Setup, pair: Pair, via: Array, box: PayloadSceneChecker
    ) -> Iterator[Proposal]:
        """Shorten the spline through given via-points, evaluate its carry, and yield the proposal.

        Nothing is yielded if the carry is not feasible, or if a carry with the same holds that
        passes obstacles on the same sides was found before.

        Args:
            setup: the cell with its placed robots.
            pair: how both arms hold the box at the start and at the goal.
            via: (k, 6 + m) via-points, box poses [m, rad] and m redundant joints [rad or m].
            box: collision checker of the box, which names the passed sides.
        """
        fitted = np.vstack([pair.start.extended, via, pair.goal.extended])
        if self._is_known(pair, box, _poses(fitted)):
            return
        self._say("the evaluator's verdict")
        begun = self.spent
        first = self._trial(setup, pair, fitted)
        certified = self.spent if first.verdict()[0].feasible else None
        self._say("a shorter way")
        straight = shorten_spline(pair.chain, pair.start, fitted, self.rng)
        found = self._trial(setup, pair, straight, first.bodies)
        judgement, why = found.verdict()
        if not judgement.feasible:
            if certified is None:
                self.refusals.append(why)
                return
            found, straight = first, fitted
        certified = certified or self.spent
        if self._is_known(pair, box, _poses(straight)):
            return
        self._say("bounds")
        # The verdict on the file takes about as long as these did.
        bounds = self._bounds(found, self.settings.seconds - 1.5 * (self.spent - begun))
        moved = self._draft(setup, pair, straight, bounds).around(bounds.carry)
        self._say("the evaluator's verdict on the file")
        try:
            last = Trial(self._workcell(moved), found.start_of(bounds.carry), found.bodies)
        except BranchLostError:
            self.refusals.append("the start posture is not among the arm's start branches")
            return
        judgement, why = last.verdict()
        if not judgement.feasible:
            self.refusals.append(why)
            return
        outputs = last.evaluator.outputs(last.initial[None])
        self.known.add((id(pair), box.sides_passed(_poses(straight))))
        self._say("the pads' way to the box")
        blocked, stand_off = ("", None) if self.out_of_time else self._pads_way(last)
        yield Proposal(
            self.problem,
            replace(moved, branches=last.branches, stand_off=stand_off),
            judgement,
            bounds.share,
            bounds.candidates,
            self.spent,
            certified,
            (outputs["q_1"][0], outputs["q_2"][0]),
            box.sides_passed(outputs["pose"][0]),
            blocked,
        )

    def _draft(
        self, setup: Setup, pair: Pair, waypoints: Array, bounds: Bounds | None = None
    ) -> Draft:
        """Build the draft of the carry through waypoints (n, 6 + m), box poses [m, rad] and m
        redundant joints [rad or m], rounded as in a file. The pads' rotations are those of `pair`.
        """
        spins = (pair.holds[0].spin, pair.holds[1].spin)
        rounded = np.round(waypoints, 4)
        return Draft(setup.workcell, spins, (-1, -1), rounded, setup.given, bounds)

    def _trial(
        self, setup: Setup, pair: Pair, waypoints: Array, bodies: CellBodies | None = None
    ) -> Trial:
        """Build the evaluator of the carry through waypoints (n, 6 + m), box poses [m, rad] and m
        redundant joints [rad or m]. The cell's `bodies` are built anew if None.
        """
        workcell = self._workcell(self._draft(setup, pair, waypoints))
        bodies = bodies or build_cell_bodies(workcell, setup.bodies)
        return Trial(workcell, pair.start.q, bodies, named=False)

    def _pads_way(self, trial: Trial) -> tuple[str, float | None]:
        """Find what blocks the pads' approach before a carry or their retreat after it. If the file
        states no stand-off and the usual one is blocked, others are tried.

        Returns:
            The obstacle as text, '' for none; and another stand-off with which nothing blocks the
            pads [m], None if there is none or none is needed.
        """
        handling = trial.workcell.handling
        blocked = grasp_blocked(trial, handling)
        if blocked and "stand_off" not in self.problem.data.get("handling", {}):
            for stand_off in STAND_OFFS:
                if not grasp_blocked(trial, replace(handling, stand_off=stand_off)):
                    return "", stand_off
        return blocked, None

    def _workcell(self, found: Draft) -> Workcell:
        return self.problem.workcell(changes(self.problem, found))

    def _bounds(self, trial: Trial, until: float) -> Bounds:
        """Find bounds of the decision variables around the carry of `trial` by random sampling.

        Args:
            trial: the carry, with its evaluator.
            until: time after the start of the whole search at which sampling ends [s].
        """
        unit, limits = decision_bounds(trial.workcell)
        low, high = self.settings.feasible
        sampling = Sampling(
            trial.feasible,
            trial.certain,
            unit,
            limits,
            self.rng,
            low,
            high,
            lambda: self.spent > until,
        )
        return sampling.bounds_around(trial.initial)


def _poses(waypoints: Array) -> Array:
    """Compute box poses (n, 6) [m, rad] along the spline through waypoints (w, 6 + m), of which the
    m redundant joints are left out."""
    basis = path_basis(len(waypoints), np.linspace(0.0, 1.0, LEAST_SAMPLES)).position
    return np.asarray((basis @ waypoints)[:, :POSE_SIZE])
