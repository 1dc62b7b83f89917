"""The carry to run, how hard to press, and why: what `hybrid_opt.recommend` gives."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from typing import Annotated

import numpy as np

from hybrid_opt.carry import Carry
from hybrid_opt.cell import Cell
from hybrid_opt.evaluate.objectives import ForceKind
from hybrid_opt.recommending.choice import Choice, DrivenPaths, Wish, choices
from hybrid_opt.recommending.comparison import BETTER, Rival, rivals
from hybrid_opt.robust.force import RobustModel, robust_model
from hybrid_opt.robust.squeeze import Squeeze, SqueezeSettings, commanded_forces
from hybrid_opt.store.json_records import Shape
from hybrid_opt.timing.jerk import drive_with_jerk
from hybrid_opt.timing.records import JerkTiming, Timing
from hybrid_opt.timing.robustness import Margin, robustness_margins
from hybrid_opt.timing.solve import time_path
from hybrid_opt.timing.use import limited_force
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.records import Uncertainty, Workcell

HAND_MADE = "hand-made"
"""Name of the workcell file's own trajectory."""

LEAST_ROOM = 0.1
"""Margins below this share of a centimetre, or of a tenth of a coefficient, are warned of."""

SHORTENED = 4
"""So often a wish for a duration is answered, each time by a shorter carry, until one keeps to it
within the cell's limits on jerk as well."""

TRIED = 8
"""Answers to a wish that are held against the independent timing before giving up."""

LEADER = 0
"""The arm that keeps its place; the other's force is commanded."""


@dataclass(frozen=True)
class Unsure:
    """One doubt, and the forces that hold all the same.

    Attributes:
        doubt: what may be off, and by how much.
        peak_force: (2,) largest normal force of each robot along the carry [N].
        within_reference: whether both stay within their reference forces.
    """

    doubt: str
    peak_force: Annotated[Array, Shape((2,))]
    within_reference: bool


@dataclass(frozen=True, eq=False)
class Recommendation:
    """The carry to run.

    Attributes:
        wish: what was asked for.
        member: its path's place in the front that it was chosen from.
        x: (n_var,) decision vector: the path, then the force limit [N].
        timing: as the independent timing drives it, every limit recomputed; its `carry` is what
            robots drive where the cell limits no jerk.
        jerk: the same path and force within the cell's limits on jerk as well, None without any.
        force_kind: which forces its limit is about, and the front's.
        limited_force: (2,) largest of them of each robot along the carry [N].
        commanded: (2,) largest normal force to command of each robot [N].
        squeeze: how these forces came about; an exported job commands the same.
        margins: how wrong the cell's description may be.
        rivals: the hand-made path, and others, at the same force and in the same time.
        unsure: forces that hold if the cell is less sure than stated.
        warnings: what speaks against it, sentences; empty where nothing does.
    """

    wish: Wish
    member: int
    x: Array
    timing: Timing
    jerk: JerkTiming | None
    force_kind: ForceKind
    limited_force: Array
    commanded: Array
    squeeze: Squeeze
    margins: tuple[Margin, ...]
    rivals: tuple[Rival, ...]
    unsure: tuple[Unsure, ...]
    warnings: tuple[str, ...]

    @property
    def carry(self) -> Carry:
        """The carry as robots drive it."""
        assert self.timing.carry is not None, "what is recommended has a timing"
        return self.timing.carry

    @property
    def force(self) -> float:
        """Limit on the forces of both robots [N]."""
        return float(self.x[-1])

    def __repr__(self) -> str:
        first, second = self.limited_force
        held = f"{self.force_kind.pressing} {first:.2f} and {second:.2f} N"
        lines = [
            f"Recommended: {self.timing.duration:.3f} s, {held}; press with "
            f"{self.commanded.max():.1f} N ({self.squeeze})",
            f"  {self.wish}",
        ]
        if self.jerk is not None:
            lines.append(
                f"  within the limits on jerk: {self.jerk.timing.duration:.3f} s "
                f"({100.0 * self.jerk.cost:+.1f} %)"
            )
        lines += [f"  {rival}" for rival in self.rivals]
        return "\n".join(lines + [f"  warning: {text}" for text in self.warnings])


def recommend(
    cell: Cell, x: Array, wish: Wish | None = None, others: Mapping[str, Array] | None = None
) -> Recommendation:
    """The carry to run of a drivable front.

    Args:
        cell: under the time law 'optimal', see `Cell.drivable`.
        x: (k, n_var) decision vectors of the front's members, certified free of collisions.
        wish: what is asked for; None for the knee.
        others: (n_path,) paths by label, beside which the answer stands; the hand-made one always
            is.

    Raises:
        SettingsError: the cell has another time law, the front is empty, or no member can do what
            is wished for.
    """
    task = cell.workcell.task
    if task.time_law != "optimal":
        raise SettingsError(
            f"the cell's time law is {task.time_law!r}, which no robot drives; give the front of "
            "cell.drivable()"
        )
    x = np.asarray(x, dtype=float).reshape(-1, task.n_var)
    if len(x) == 0:
        raise SettingsError(
            "the drivable front is empty: no feasible carry was found; give the search more "
            "evaluations or the task wider bounds"
        )
    wish = wish or Wish()
    paths = DrivenPaths.of(cell, x[:, :-1])
    members = paths.timings(x[:, -1])
    points = np.array([[member.duration, member.limited_force] for member in members])
    choice, timing, jerk = _answer(cell, x, paths, points, wish)
    assert timing.carry is not None, "the timing respects every limit"
    named = {HAND_MADE: cell.initial[:-1]} | dict(others or {})
    beside = rivals(
        cell, named, front=paths, points=points, member=choice.index, force=choice.force
    )
    forces = limited_force(timing.carry, cell.workcell, timing.limits)
    margins = robustness_margins(cell.timing_model, timing.carry)
    peak, squeeze, doubt = _commanded(timing.carry)
    return Recommendation(
        wish=wish,
        member=choice.index,
        x=timing.carry.x,
        timing=timing,
        jerk=jerk,
        force_kind=cell.force_kind,
        limited_force=forces.max(axis=0),
        commanded=peak,
        squeeze=squeeze,
        margins=margins,
        rivals=beside,
        unsure=unsure_forces(timing.carry),
        warnings=(
            *_warnings(beside, timing, choice.force),
            *_too_long(wish, jerk),
            *_without_room(margins),
            *doubt,
        ),
    )


def _answer(
    cell: Cell, x: Array, paths: DrivenPaths, points: Array, wish: Wish
) -> tuple[Choice, Timing, JerkTiming | None]:
    """What answers a wish, and its timing within the cell's limits on jerk, which keeps to a wish
    for a duration as well where any path does."""
    found, asked = None, wish
    for _ in range(SHORTENED):
        try:
            choice, timing = _driven(cell, x, choices(cell.workcell, paths, points, asked))
        except SettingsError:
            if found is None:
                raise
            break  # no path is as much faster as the limits on jerk take longer
        assert timing.carry is not None, "the timing respects every limit"
        jerk = drive_with_jerk(cell.timing_model, timing.carry.x)
        found = choice, timing, jerk
        if jerk is None or asked.duration is None or not _exceeds(wish, jerk):
            break
        assert wish.duration is not None, "a duration is asked for where it is wished for"
        asked = Wish(duration=asked.duration * wish.duration / jerk.timing.duration)
    assert found is not None, "the first round found it or raised"
    return found


def _exceeds(wish: Wish, jerk: JerkTiming) -> bool:
    """Whether limits on jerk take longer than was wished for."""
    if wish.duration is None or not jerk.timing.ok:
        return False
    return jerk.timing.duration > wish.duration * (1.0 + BETTER)


def _driven(cell: Cell, x: Array, wanted: Iterable[Choice]) -> tuple[Choice, Timing]:
    """The first choice that the independent timing confirms."""
    reason, model = "", cell.timing_model
    for choice in islice(wanted, TRIED):
        decision = np.append(x[choice.index, :-1], choice.force)
        timing = time_path(model, decision, model.drive_limits(choice.force))
        if timing.ok:
            return choice, timing
        reason = timing.reason
    raise SettingsError(f"no carry of the front can be driven as wished for: {reason}")


def _commanded(carry: Carry) -> tuple[Array, Squeeze, tuple[str, ...]]:
    """The largest forces to press with (2,) [N], how they came about, and warnings about them."""
    doubts = []
    try:
        forces, squeeze = commanded_forces(carry.workcell, carry, SqueezeSettings())
    except SettingsError as error:
        forces, squeeze = commanded_forces(carry.workcell, carry, SqueezeSettings(1.0))
        doubts.append(f"no robust forces: {error}")
    peak = np.asarray(forces.max(axis=0))
    if not squeeze.even_pads:
        doubts.append(
            "the squeeze holds pads that choose their pressure; what pads that press evenly need "
            "is known for two pads with opposite normals only"
        )
    allowed = carry.workcell.task.reference_force
    if (peak > allowed).any():
        doubts.append(
            f"pressing with {peak.max():.1f} N exceeds the reference force of "
            f"{allowed.min():.1f} N; wish for a longer carry or less force"
        )
    return peak, squeeze, tuple(doubts)


def _warnings(beside: Iterable[Rival], timing: Timing, force: float) -> Iterator[str]:
    """Warnings about the recommended carry."""
    for rival in beside:
        if rival.duration_at_force < timing.duration * (1.0 - BETTER):
            yield (
                f"the {rival.label} trajectory is better: at {force:.2f} N it takes "
                f"{rival.duration_at_force:.3f} s instead of {timing.duration:.3f} s"
            )
        elif rival.faster_between is not None:
            low, high = rival.faster_between
            where = f"at {low:.2f} N" if low == high else f"between {low:.2f} and {high:.2f} N"
            yield (
                f"the {rival.label} trajectory is faster than the whole front {where}; a longer "
                "search or polish would help there"
            )


def _too_long(wish: Wish, jerk: JerkTiming | None) -> Iterator[str]:
    """That limits on jerk take longer than was wished for."""
    if jerk is not None and _exceeds(wish, jerk):
        yield (
            f"within the limits on jerk it takes {jerk.timing.duration:.3f} s instead of "
            f"{wish.duration:g} s, and no other carry of the front was found to take less"
        )


def _without_room(margins: Iterable[Margin]) -> Iterator[str]:
    """Warnings about margins that are used up."""
    tight = [
        margin
        for margin in margins
        if margin.fails and abs(margin.limit - margin.nominal) < LEAST_ROOM * _whole(margin)
    ]
    if tight:
        yield (
            f"no room is left for errors of {', '.join(margin.quantity for margin in tight)} "
            f"({tight[0].fails}); wish for a longer carry, or state the errors as [uncertainty]"
        )


def _whole(margin: Margin) -> float:
    """Scale of a margin: a tenth of a coefficient, a length of a centimetre."""
    return 1e-2 if margin.unit == "m" else 0.1 * margin.nominal


def usual_doubts(workcell: Workcell) -> dict[str, Uncertainty]:
    """Doubts by what they are called; the cell's own set comes first where it has one."""
    doubts = {
        "friction 10 % off": Uncertainty(friction=0.1),
        "friction 20 % off": Uncertainty(friction=0.2),
        "mass 5 % off": Uncertainty(mass=0.05),
        "centre of mass 10 mm off": Uncertainty(centre_of_mass=np.full(3, 0.01)),
    }
    own = workcell.uncertainty
    return ({} if own.is_empty else {"all that [uncertainty] states": own}) | doubts


def unsure_forces(carry: Carry, model: RobustModel | None = None) -> tuple[Unsure, ...]:
    """The forces that hold a carry under each of the usual doubts.

    A doubt that leaves no friction or no patch is left out; so are all where the pads cannot hold
    whatever happens.
    """
    workcell = carry.workcell
    try:
        model = model or robust_model(workcell)
    except SettingsError:
        return ()
    found = []
    for doubt, uncertainty in usual_doubts(workcell).items():
        try:
            peak = model.robust_force(carry, uncertainty, LEADER).peak
        except SettingsError:
            continue
        fits = bool((peak <= workcell.task.reference_force).all())
        found.append(Unsure(doubt, peak, fits))
    return tuple(found)
