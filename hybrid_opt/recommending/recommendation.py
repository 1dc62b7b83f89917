"""The recommended carry with its commanded force, and the reasons for it: the result of
`hybrid_opt.recommend`.

The recommendation is one carry with one duration, as robots drive it, and one commanded force,
which holds the box in every case of the cell's uncertainty.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.carry import Carry, at_rest, box_motion
from hybrid_opt.cell import Cell
from hybrid_opt.display_protocol import Displayable
from hybrid_opt.errors import JobError
from hybrid_opt.evaluate.objectives import ROBUST_FORCE, ForceKind
from hybrid_opt.front import Front
from hybrid_opt.job.compliance import separation
from hybrid_opt.job.plan import CommandedForces, command_forces, job_model
from hybrid_opt.job.records import Job
from hybrid_opt.progress import ShowProgress, progress_bar
from hybrid_opt.recommending.advice import Advice, advice, commanded_margins
from hybrid_opt.recommending.choice import (
    FORCES,
    DrivenPaths,
    Goal,
    Option,
    Wish,
    best_of_paths,
    commanded_at_most,
    duration_alone,
    force_alone,
    refuse,
    wished_cell,
)
from hybrid_opt.robust.budget import (
    GripBudget,
    Remedy,
    Reserve,
    cheapest_remedies,
    remedies_text,
    reserve,
)
from hybrid_opt.robust.cases import LEADER
from hybrid_opt.robust.force import robust_model, subsample
from hybrid_opt.robust.squeeze import MOST, Squeeze, largest_commanded
from hybrid_opt.static_hold import static_hold
from hybrid_opt.timing.jerk import driven_timing
from hybrid_opt.timing.records import Timing
from hybrid_opt.timing.robustness import Margin
from symbolic.array import Array, Figure, evenly
from symbolic.errors import SettingsError
from symbolic.records import Workcell, quantities
from symbolic.records.cell import PARTNER_TIME

HAND_MADE = "hand-made"
"""Name of the workcell file's own trajectory."""

SHORTENED = 4
"""How often a path is timed at most, each time with more margin, until the carry without jumps of
acceleration fulfils the wish."""

TRIED = 3
"""Number of paths that are timed within jerk limits before the best of them is chosen."""

GENTLER = 3
"""How often carries of less commanded force are tried at most, if the best carry's job exceeds a
limit."""

STEPS = 4 + FORCES
"""Number of steps of a recommendation, for a progress display. Each compared path adds one."""


@dataclass(frozen=True, eq=False, repr=False)
class Recommendation(Displayable):
    """The recommended carry, with its forces, its job and the reasons for it.

    Attributes:
        wish: the user's target of the recommendation.
        member: index of the carry's path in the front.
        x: (n_var,) decision vector: the path, then the force limit [N].
        timing: timing of the carry within all limits, jerk limits included, without jumps of
            acceleration.
        force_kind: kind of force, planned or robust, that the force limit bounds.
        limited_force: (2,) largest force of this kind that each robot exerts along the carry [N].
        commanded: (2,) largest commanded normal force of each robot [N].
        squeeze: record of how the commanded forces were computed, with their contributions.
        job: the whole job around the carry; None if no job can be planned.
        margins: for each quantity of the cell, how far it may be off before the commanded force no
            longer holds the box.
        rivals: other paths, such as the hand-made one, at the same force or duration.
        advice: effects of changes of the cell on force and duration.
        warnings: objections to the carry, as sentences.
        required: (2,) largest normal force that each robot needs in any case of the uncertainty
            [N].
        budget: grip budget of the box at rest.
        remedies: smallest changes of the cell that bring `required` within the reference forces;
            empty if no change is necessary.
        reserve: largest mass and least friction with which the required forces stay within the
            reference forces.
        why: reason of the choice, as a text.
    """

    wish: Wish
    member: int
    x: Array
    timing: Timing
    force_kind: ForceKind
    limited_force: Array
    commanded: Array
    squeeze: Squeeze
    job: Job | None
    margins: tuple[Margin, ...]
    rivals: tuple[Alternative, ...]
    advice: tuple[Advice, ...]
    warnings: tuple[str, ...]
    required: Array
    budget: GripBudget
    remedies: tuple[Remedy, ...]
    reserve: Reserve
    why: str

    @property
    def fits(self) -> bool:
        """True if the required forces are within the reference forces."""
        return is_within(self.required, self.budget.allowed)

    @property
    def objection(self) -> str:
        """Reason not to run the carry, with a remedy; '' if the required forces are within the
        reference forces.
        """
        if self.fits:
            return ""
        return f"no carry fits: {self.budget}; {remedies_text(self.remedies, 'for this carry')}"

    @property
    def carry(self) -> Carry:
        """Carry under the recommended timing."""
        assert self.timing.carry is not None, "what is recommended has a timing"
        return self.timing.carry

    @property
    def duration(self) -> float:
        """Duration of the carry as robots drive it [s], rounded up to whole ticks if a job is
        planned.
        """
        return self.timing.duration if self.job is None else self.job.phase("carry").duration

    @property
    def limit(self) -> float:
        """Force limit of the carry [N]: the last entry of `x`, with which the search found it."""
        return float(self.x[-1])

    @property
    def force(self) -> float:
        """Largest commanded normal force of the force-controlled arm [N]."""
        return self.squeeze.force

    def __repr__(self) -> str:
        job = "" if self.job is None else f", the job takes {self.job.duration:.2f} s"
        found = f"{self.duration:.3f} s, {self.squeeze.order} {self.force:.1f} N{job}"
        lines = [f"Recommended: {found}"]
        if not self.fits:
            objection = f"N{self.objection[1:]}"
            lines = [objection, f"If you allow {self.required.max():.1f} N: {found}"]
        lines += [f"  {self.why}", f"  {self.squeeze}: {self.squeeze.breakdown}"]
        lines += [f"  within the reference force: {self.reserve}"]
        lines += [f"  {each}" for each in self.rivals]
        lines += [f"  on this path, {each}" for each in self.advice]
        return "\n".join(lines + [f"  warning: {text}" for text in self.warnings])


def recommend(
    front: Front,
    wish: Wish | None = None,
    others: Mapping[str, Array] | None = None,
    progress: ShowProgress = False,
    alone: bool = False,
) -> Recommendation:
    """Recommend the carry of a drivable front to run.

    By default the carry with the least product of duration and commanded force is recommended.
    Carries are excluded if a robot needs more than its reference force to hold the box in every
    case of the uncertainty. If all do, none is excluded, and `Recommendation.objection` states the
    necessary changes of the cell.

    Args:
        front: front of a drivable cell, whose carries are timed from rest to rest within all limits
            (`Cell.drivable`).
        wish: another target, or numbers that replace the cell's; None for the default target.
        others: further paths (n_path,) by label, to compare with the recommended carry; the
            hand-made path is always compared. None for no further paths.
        progress: True for a progress bar, or a function of the finished and the total number of
            steps.
        alone: True to leave out the margins, the comparison with other paths and the advice.

    Raises:
        SettingsError: the cell is not drivable, the front is empty, no member fulfils the wish, or
            the uncertainty leaves no friction or patch.
        WorkcellError: the cell with the numbers of the wish is invalid.
    """
    wish = wish or Wish()
    cell = wished_cell(front.cell, wish)
    _require_members(cell, front)
    named: dict[str, Array] = {} if alone else {HAND_MADE: cell.initial[:-1]} | dict(others or {})
    with progress_bar(progress, "recommendation", STEPS + len(named)) as advance:
        rows = spread_rows(front.x[:, :-1])
        paths = DrivenPaths(cell, front.x[rows, :-1])
        options = paths.all_options(front.x[rows, -1], lambda: advance(1))
        goal, budget = Goal.of(wish, cell.workcell), cell.grip_budget
        why = str(wish)
        if not wish.has_target and not any((each.force <= goal.hardest).all() for each in options):
            goal = replace(goal, hardest=np.full(2, np.inf))
            why = f"{wish}, of carries that all exceed the reference force"
        refuse(options, wish, goal, budget)
        option, timing, is_kept = _driven(cell, paths, options, goal, wish.has_target)
        held = command_forces(job_model(cell.timing_model), timing)
        if not is_kept:
            why = "least excess over the reference force of the carries that were driven"
        elif held.problem is not None and held.problem.code == "beyond-a-limit":
            gentler = _with_job(cell, paths, options, goal, held.squeeze.force)
            if gentler is not None:
                option, timing, held = gentler
                why = f"{why}, with less force, because the job with more exceeds a limit"
        advance(1)
        carry, limits = timing.carry, cell.timing_model.carry_limits
        assert carry is not None, "what is recommended has a timing"
        forces, squeeze, job, doubts = held.forces, held.squeeze, held.job, _objections(held)
        commanded = np.asarray(forces.max(axis=0)) if job is None else job.peak_normal_force
        allowed, remedies = cell.workcell.task.reference_force, tuple[Remedy, ...]()
        required = np.maximum(commanded, required_forces(cell.workcell, carry))
        largest = carry.normal_force[:, 1 - LEADER], forces[:, 1 - LEADER]
        most = box_motion(carry).at(np.union1d(*[np.argsort(-each)[:MOST] for each in largest]))
        needs = (robust_model(cell.workcell), most, required, allowed)
        if not is_within(required, allowed):
            remedies = cheapest_remedies(*needs)
        advance(1)
        beside = []
        for label, path in named.items():
            beside.append(time_alternative(cell, label, path, timing, squeeze.force))
            advance(1)
        better = tuple(_better(beside, timing, squeeze.force))
        if not alone and cell.workcell.handling.partner_stop is not None:
            free = cell.changed({"handling.partner_stop": quantities.SEPARATION.high})
            label = "the same path without partner_stop"
            beside.append(time_alternative(free, label, carry.x[:-1], timing, squeeze.force))
        margins = () if alone else commanded_margins(carry, forces)
        advance(1)
        hints = () if alone else advice(cell, paths, option, timing)
        advance(1)
        return Recommendation(
            wish=wish,
            member=int(rows[option.index]),
            x=carry.x,
            timing=timing,
            force_kind=cell.force_kind,
            limited_force=limits.limited_force(carry, timing.limits).max(axis=0),
            commanded=commanded,
            squeeze=squeeze,
            job=job,
            margins=margins,
            rivals=tuple(beside),
            advice=hints,
            warnings=(*doubts, *better),
            required=required,
            budget=budget,
            remedies=remedies,
            reserve=Reserve(np.nan, np.nan) if alone else reserve(*needs),
            why=why,
        )


def _require_members(cell: Cell, front: Front) -> None:
    """Raise an error unless the cell is drivable and the front has members.

    Args:
        cell: cell of the recommendation.
        front: its front.

    Raises:
        SettingsError: the cell is not drivable, or the front is empty.
    """
    if not cell.workcell.task.law.is_drivable:
        raise SettingsError(
            f"the cell's time law is {cell.workcell.task.law.name!r}, which no robot drives; give "
            "the front of cell.drivable()",
            code="not-drivable",
        )
    if len(front.x) == 0:
        raise SettingsError(
            "the drivable front is empty: no feasible carry was found; give the search more "
            "evaluations or the task wider bounds",
            code="empty-front",
        )


def _driven(
    cell: Cell, paths: DrivenPaths, options: Sequence[Option], goal: Goal, wished: bool
) -> tuple[Option, Timing, bool]:
    """Choose the carry to recommend, by timings that robots can drive.

    The options' timings have jumps of acceleration. The best paths are timed again without them. If
    a path then exceeds a limit of the goal, shorter or gentler options of the same path are tried.

    Args:
        cell: drivable cell.
        paths: paths of the front.
        options: timings of these paths within several force limits; their accelerations jump.
        goal: limits on duration and force, and the cost to minimise.
        wished: True if the user gave a duration or force. If False and no carry keeps the limits,
            the carry is chosen that exceeds the force limits least.

    Returns:
        Path and force limit of the carry, its timing, and True if it keeps the limits of the goal.

    Raises:
        SettingsError: no carry can be driven as wished.
    """
    kept, others, reason, model = [], [], "", cell.timing_model
    for first in best_of_paths(paths, options, goal, TRIED):
        own, asked = [option for option in options if option.index == first.index], goal
        option: Option | None = first
        for _ in range(SHORTENED):
            if option is None:
                break
            try:
                timing = driven_timing(model, np.append(paths.x[option.index], option.limit))
            except JobError as error:
                reason = str(error)
                break
            if not timing.ok or timing.carry is None:
                reason = timing.reason
                break
            most = required_forces(cell.workcell, timing.carry)
            late, hard = timing.duration / goal.longest, float((most / goal.hardest).max())
            found = (option, timing)
            if max(late, hard) <= 1.0 + BETTER:
                kept.append((goal.cost(timing.duration, float(most[1 - LEADER])), found))
                break
            others.append((hard, found))
            needs = f"it takes {timing.duration:.3f} s and needs {most[1 - LEADER]:.1f} N commanded"
            reason = f"without jumps of the acceleration {needs}"
            longest, hardest = asked.longest / max(late, 1.0), asked.hardest / max(hard, 1.0)
            asked = replace(asked, longest=longest, hardest=hardest)
            option = next(best_of_paths(paths, own, asked, 1), None)
    if not kept and (wished or not others):
        raise SettingsError(f"no carry of the front can be driven as wished for: {reason}")
    return *min(kept or others, key=lambda each: each[0])[1], bool(kept)


def _with_job(
    cell: Cell, paths: DrivenPaths, options: Sequence[Option], goal: Goal, force: float
) -> tuple[Option, Timing, CommandedForces] | None:
    """Choose a carry whose job keeps all limits: try slower carries with less and less commanded
    force.

    A job may exceed a limit that its carry's timing keeps, because timings limit joint torques
    under the planned forces, jobs under the commanded ones. Each trial halves the excess of the
    commanded force over the least one of all carries.

    Args:
        cell, paths, options, goal: as for `_driven`.
        force: commanded force of the carry whose job exceeds a limit [N].

    Returns:
        Path and force limit of the carry, its timing, and its commanded forces with the job; None
        if no carry with a job was found.
    """
    least = min(option.commanded for option in options)
    for _ in range(GENTLER):
        force = (least + force) / 2.0
        asked = replace(goal, hardest=commanded_at_most(force, goal.hardest))
        try:
            option, timing, _ = _driven(cell, paths, options, asked, wished=True)
        except SettingsError:
            return None
        held = command_forces(job_model(cell.timing_model), timing)
        if held.job is not None:
            return option, timing, held
    return None


def required_forces(workcell: Workcell, carry: Carry) -> Array:
    """Compute the largest normal force (2,) [N] that each robot needs along a carry in any case of
    the uncertainty.

    For the force-controlled arm this is the commanded force, for the position-controlled arm the
    force that results from it.

    Args:
        workcell: the cell.
        carry: the carry.
    """
    uncertainty, (rows, motion) = workcell.uncertainty, subsample(carry)
    most = largest_commanded(workcell, motion, carry.normal_force[rows], uncertainty, LEADER)
    leading = robust_model(workcell).hold(motion, uncertainty, LEADER)[1]
    most[LEADER] = max(most[LEADER], leading.max())
    return most


def _objections(found: CommandedForces) -> list[str]:
    """Return sentences that object to running a carry; an empty list for none.

    There are three objections:

    - no job is possible;
    - no uncertainty is stated;
    - a stop of one arm would pull the pads too far apart.

    Args:
        found: commanded forces of the carry, with its job.
    """
    squeeze, doubts = found.squeeze, []
    if found.job is None:
        doubts.append(f"no job can be planned: {found.problem}")
    if squeeze.uncertainty is not None and squeeze.uncertainty.is_empty:
        doubts.append("the cell states that nothing is uncertain: state what may be off")
    job = found.job
    allowed = None if job is None else job.workcell.handling.partner_stop
    if job is not None and allowed is not None:
        # The timing limits the speed of the box's centre alone.
        apart = separation(job, PARTNER_TIME)
        if apart > allowed * (1.0 + BETTER):
            doubts.append(
                f"the box turns, too: one arm's own stop moves the pads {1e3 * apart:.0f} mm "
                f"apart, not {1e3 * allowed:.0f} mm; time it with partner_stop = "
                f"{allowed**2 / apart:.3f}"
            )
    return doubts


def is_within(required: Array, allowed: Array) -> bool:
    """Return True if forces stay within limits, up to the relative tolerance `BETTER`.

    Args:
        required: (2,) required force of each robot [N].
        allowed: (2,) largest allowed force of each robot [N].
    """
    return bool((required <= allowed * (1.0 + BETTER)).all())


def _better(beside: Sequence[Alternative], timing: Timing, force: float) -> Iterator[str]:
    """Yield a sentence for each alternative path that is faster than the recommended carry at the
    same commanded force.

    Args:
        beside: alternative paths, compared with the recommended carry.
        timing: timing of the recommended carry.
        force: commanded force of the recommended carry [N].
    """
    for other in beside:
        if other.duration_at_force < timing.duration * (1.0 - BETTER):
            yield (
                f"the {other.label} trajectory is better: with {force:.1f} N commanded it takes "
                f"{other.duration_at_force:.3f} s instead of {timing.duration:.3f} s; a longer "
                "search or polish would help"
            )


BETTER = 1e-3
"""A compared path counts as faster if it is shorter by more than this share: timings are no more
accurate."""

ABOVE_STILL = (1.02, 1.04, 1.06, 1.08, 1.12, 1.2)
"""Forces of the table of durations, as multiples of the force that holds the payload level and at
rest."""

MEMBERS = 24
"""Number of members of a front that are timed, evenly spread over the front."""


@dataclass(frozen=True, repr=False)
class Alternative:
    """A path that is compared with the recommended carry under the same limits.

    Attributes:
        label: name of the path.
        duration_at_force: shortest duration with the recommended carry's commanded force [s];
            infinite if that force does not suffice.
        force_at_duration: least commanded force in the recommended carry's duration [N]; infinite
            if that duration is too short.
    """

    label: str
    duration_at_force: Figure
    force_at_duration: Figure

    def __repr__(self) -> str:
        force = "cannot be held with the same force"
        time = "cannot be driven in the same time"
        if np.isfinite(self.duration_at_force):
            force = f"{self.duration_at_force:.3f} s at the same force"
        if np.isfinite(self.force_at_duration):
            time = f"{self.force_at_duration:.1f} N in the same time"
        return f"{self.label}: {force}, {time}"


def time_alternative(
    cell: Cell, label: str, path: Array, timing: Timing, force: float
) -> Alternative:
    """Compare a path with the recommended carry: find its shortest duration with the carry's
    commanded force, and its least commanded force within the carry's duration.

    Args:
        cell: drivable cell: its carries are timed from rest to rest within all limits.
        label: name of the path.
        path: (n_path,) decision vector of the path, without a force limit.
        timing: timing of the recommended carry.
        force: commanded force of the recommended carry [N].
    """
    assert timing.limits.force is not None, "drivable carries have a force limit"
    paths = DrivenPaths(cell, path)
    options = paths.all_options(timing.limits.force)
    goal = Goal(np.inf, commanded_at_most(force), duration_alone)
    found = next(best_of_paths(paths, options, goal, 1), None)
    longer, duration = 1.0, float("inf")
    if found is not None:
        with suppress(JobError):
            driven = driven_timing(cell.timing_model, np.append(path, found.limit))
            duration = driven.duration if driven.ok else duration
            longer = max(driven.duration / found.duration, 1.0) if driven.ok else 1.0
    in_time = Goal(timing.duration / longer, np.full(2, np.inf), force_alone)
    same = next(best_of_paths(paths, options, in_time, 1), None)
    return Alternative(label, duration, float("inf") if same is None else same.commanded)


def level_force(workcell: Workcell, kind: ForceKind) -> float:
    """Compute the normal force [N] that holds the payload level and at rest, the larger of the two
    robots' forces.

    Args:
        workcell: the cell.
        kind: kind of force to compute, planned or robust.

    Raises:
        SettingsError: the uncertainty leaves no friction or contact patch.
    """
    if not kind.robust:
        return float(static_hold(workcell).normal_force.max())
    return float(np.max(robust_model(workcell).hold(at_rest(), workcell.uncertainty)))


def table_forces(workcell: Workcell) -> Array:
    """Return commanded forces (n,) [N], for a table of the shortest duration with each of them.

    They are multiples of the force that holds the payload level and at rest in every case of the
    uncertainty, followed by the reference force of the force-controlled arm.

    Raises:
        SettingsError: the uncertainty leaves no friction or contact patch.
    """
    allowed = float(workcell.task.reference_force[1 - LEADER])
    forces = level_force(workcell, ROBUST_FORCE) * np.array(ABOVE_STILL)
    return np.append(forces[forces < allowed], allowed)


def commanded_durations(paths: DrivenPaths, limits: Array | float, forces: Array) -> Array:
    """Compute for each of n limits on the commanded force the duration (n,) [s] of the fastest of k
    paths; infinite if no path has a timing within the limit.

    Limits on jerk are ignored.

    Args:
        paths: the paths.
        limits: force limit with which each path was found, (k,) or one for all paths [N].
        forces: (n,) limits on the commanded force [N].
    """
    if not len(paths):
        return np.full(len(forces), np.inf)
    if paths.robust:  # the limit is one of what is commanded
        return np.array([paths.durations(force).min() for force in forces.tolist()])
    options = paths.all_options(limits)

    def shortest(force: float) -> float:
        goal = Goal(np.inf, commanded_at_most(force), duration_alone)
        best = best_of_paths(paths, options, goal, TRIED)
        return min((option.duration for option in best), default=np.inf)

    return np.array([shortest(force) for force in forces.tolist()])


def spread_rows(paths: Array) -> NDArray[np.intp]:
    """Choose at most `MEMBERS` distinct rows of an array (k, n_path) of paths, evenly spread, the
    first and the last distinct row among them. Return their indices in increasing order.
    """
    different = np.sort(np.unique(paths, axis=0, return_index=True)[1])
    return np.asarray(different[evenly(len(different), MEMBERS)])
