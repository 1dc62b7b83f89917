"""Evaluation of candidates: compiled physics, collision verdict, objectives, feasibility.

Every search calls this evaluation. A candidate is a decision vector, evaluated on the task's
samples. All objectives of an infeasible candidate take the paper's penalty (Eq. 60), extended to
every constraint: 1 + (time in violation, summed over the constraints) / duration. The evaluation
also returns the violation of each constraint, for searches by constraint domination.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, fields, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from codegen.function import NumericFunction
from hybrid_opt.carry import DRIVE_CONSTRAINTS, Carry, Judgement, carry_from_outputs
from hybrid_opt.collision.certify import (
    Certificate,
    LostPathError,
    SampledPath,
    certificates,
)
from hybrid_opt.collision.checker import CollisionChecker
from hybrid_opt.compiled_cell import CompiledCell
from hybrid_opt.evaluate.kernel import (
    Kernel,
    SampledVerdicts,
    collision_shares,
    evaluate_numpy,
    load_kernel,
)
from hybrid_opt.evaluate.objectives import (
    PAPER_OBJECTIVES,
    Objective,
    force_kind,
    non_dominated,
    select_objectives,
)
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.functions import CONSTRAINTS, SAMPLE_NAMES
from symbolic.path.spline import extended_waypoints
from symbolic.records import Workcell

if TYPE_CHECKING:
    from hybrid_opt.timing.candidates import CandidateDriver


COLLISION = "collision"
BETWEEN_SAMPLES = "between_samples"
NOT_FINITE = "not_finite"

REASONS = (*CONSTRAINTS, COLLISION, BETWEEN_SAMPLES, NOT_FINITE, *DRIVE_CONSTRAINTS)
"""Reasons for which a candidate is infeasible; `Evaluations.reason` is an index into them.

between_samples: not proven free of collisions between the samples; only fronts are certified.
not_finite: an objective is NaN or infinite, because a solver or the model failed.
`hybrid_opt.carry.DRIVE_CONSTRAINTS`: only in drivable cells.
"""

FEASIBLE = -1
"""`Evaluations.reason` of a feasible candidate."""


@dataclass(frozen=True, repr=False)
class Evaluations:
    """Evaluations of n candidates.

    Attributes:
        x: (n, n_var) decision vectors.
        objectives: (n, m) values without penalty; meaningful only for feasible candidates.
        penalised: (n, m) objectives with the paper's penalty, always finite, for searches.
        feasible: (n,) True for feasible candidates.
        reason: (n,) index into `REASONS` of the constraint that is violated first along the path;
            `FEASIBLE` if there is none.
        position: (n,) path parameter in [0, 1] of the first violation; NaN if feasible.
        violation: (n, len(REASONS)) violation of each constraint, 0 if satisfied, in the unit of
            the constraint (`symbolic.functions.CONSTRAINTS`). For `collision` it is the share of
            the duration in collision, for `between_samples` and `not_finite` 0 or 1.
        violation_time: (n, len(REASONS)) time in violation of each constraint over the duration.
    """

    x: Array
    objectives: Array
    penalised: Array
    feasible: NDArray[np.bool_]
    reason: NDArray[np.int8]
    position: Array
    violation: Array
    violation_time: Array

    def __len__(self) -> int:
        return len(self.x)

    def judgement(self, row: int, objective_names: Sequence[str]) -> Judgement:
        """Return feasibility and objectives of one candidate as a record; if it is infeasible, also
        the constraint that it violates first and where.

        Args:
            row: index of the candidate.
            objective_names: names of the objectives, in the order of the columns of `objectives`.
        """
        feasible = bool(self.feasible[row])
        return Judgement(
            feasible=feasible,
            reason="" if feasible else REASONS[int(self.reason[row])],
            position=None if feasible else float(self.position[row]),
            objectives=dict(zip(objective_names, self.objectives[row].tolist(), strict=True)),
        )

    @property
    def infeasible_by_reason(self) -> dict[str, int]:
        """Number of infeasible candidates by the constraint that each candidate violates first.

        The largest number comes first.
        """
        counts = {name: int(np.sum(self.reason == i)) for i, name in enumerate(REASONS)}
        found = sorted(counts.items(), key=lambda item: -item[1])
        return {name: count for name, count in found if count}

    def __repr__(self) -> str:
        share = 100.0 * float(self.feasible.mean()) if len(self) else 0.0
        counts = [f"{c} {n.replace('_', ' ')}" for n, c in self.infeasible_by_reason.items()]
        return f"{len(self)} candidates, {share:.1f} % feasible" + "".join(
            f"; {count}" for count in counts
        )

    def __getitem__(self, rows: slice | NDArray[np.intp] | NDArray[np.bool_]) -> Evaluations:
        return Evaluations(**{f.name: getattr(self, f.name)[rows] for f in fields(self)})


def concatenated(parts: list[Evaluations]) -> Evaluations:
    """Concatenate at least one record of evaluations, in order."""
    return Evaluations(
        **{f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Evaluations)}
    )


MOST_KNOWN = 4096
"""Number of paths whose certification is cached; beyond it the cache starts anew."""


class CandidateEvaluator:
    """Evaluator for the candidates of one workcell, with a fixed selection of objectives.

    Attributes:
        workcell: the workcell.
        compiled: the workcell with its compiled functions.
        objectives, objective_names: the minimised objectives, and their names.
        functions: the compiled functions by name.
        checker: collision checker of the workcell.
        n_var, lower, upper: size and bounds of the decision vector.
        driver: timer of the candidates of a drivable cell (whose carries are timed from rest to
            rest within all limits), else None.
        threads: number of threads that share a batch.
    """

    def __init__(
        self,
        workcell: Workcell,
        objectives: Sequence[str | Objective] = PAPER_OBJECTIVES,
        threads: int = 1,
        functions: Mapping[str, NumericFunction] | None = None,
        driver: CandidateDriver | None = None,
        compiled: CompiledCell | None = None,
    ) -> None:
        """Load or build the compiled functions.

        Args:
            workcell: the workcell.
            objectives: objectives to be minimised, by name or as `Objective` records.
            threads: number of threads that share a batch.
            functions: compiled functions of `symbolic.functions` by name; loaded or built if None.
            driver: timer of the candidates of a drivable cell, whose carries are timed from rest to
                rest within all limits; None to build it. Other cells have none.
            compiled: the workcell with its compiled functions, to share them; created if None.

        Raises:
            SettingsError: an objective is unknown or given twice.
            DualArmError: the model or its code cannot be built.
        """
        self.workcell = workcell
        self.compiled = CompiledCell(workcell) if compiled is None else compiled
        self.objectives = select_objectives(objectives)
        self.objective_names = tuple(objective.name for objective in self.objectives)
        self.threads = threads
        self.functions = self.compiled.evaluators if functions is None else functions
        self.checker = CollisionChecker(self.compiled.geometry, self.functions)
        self.driver = self._driver(threads) if driver is None else driver
        candidate = self.functions["candidate"]
        self._outputs: Callable[[Array], dict[str, Array]] = (
            partial(candidate.batch, threads=threads)
            if self.driver is None
            else partial(self.driver.outputs, candidate)
        )
        self.n_var = workcell.task.n_var
        self.lower = workcell.task.lower
        self.upper = workcell.task.upper
        self._needs = _needs(self.objectives)
        self._begin: Array | None = None
        self._proofs: dict[bytes, float | None] = {}
        compiled_here = functions is None and self.compiled.is_compiled
        self._in_lanes = compiled_here and self.driver is None

    @cached_property
    def _kernel(self) -> Kernel | None:
        """Compiled evaluation of several candidates side by side; None if the machine or the cell
        does not support it.
        """
        return load_kernel(self.compiled, self.checker, self.outputs) if self._in_lanes else None

    def _driver(self, threads: int) -> CandidateDriver | None:
        if not self.workcell.task.law.is_drivable:
            return None
        # Not imported at the top: other time laws need no timing, and hence no CasADi.
        from hybrid_opt.timing.candidates import CandidateDriver
        from hybrid_opt.timing.solve import PathTimer

        timer = PathTimer(self.compiled, threads=threads)
        return CandidateDriver(timer, threads, force_kind(self.objectives).robust)

    def beginning_at(self, q_1: Array, q_2: Array) -> CandidateEvaluator:
        """Return a copy of the evaluator with other start postures.

        Only `evaluate` and `certified` use these postures; `outputs` and `carry` keep the cell's
        own start branches.

        Args:
            q_1, q_2: (n,) joints of each arm that hold the box at the start [rad].

        Raises:
            SettingsError: the compiled kernel, which evaluates several candidates side by side, is
                not available for this cell, these objectives or this machine.
        """
        if self._kernel is None or self._needs is None:
            raise SettingsError(
                "start branches are compared by the evaluation in lanes, which this cell, these "
                "objectives or this machine do not have; give the robots' start_branch as numbers"
            )
        other = copy(self)
        other._begin = np.concatenate([q_1, q_2]).astype(float)
        other._proofs = {}
        return other

    def outputs(self, x: Array) -> dict[str, Array]:
        """Compute poses, joint positions, forces and all other outputs of
        `symbolic.functions.candidate_function` at the samples of candidates.

        In drivable cells, whose carries are timed from rest to rest within all limits, the outputs
        of `hybrid_opt.timing.candidates.CandidateDriver.outputs` are added.

        Args:
            x: (n, n_var) decision vectors.

        Returns:
            Arrays (n, samples, ...) by name of the output.
        """
        return self._outputs(self._checked(x))

    def evaluate(self, x: Array, with_collisions: bool = True) -> Evaluations:
        """Evaluate decision vectors.

        Args:
            x: (n, n_var) decision vectors.
            with_collisions: False to skip the collision check. Without the compiled kernel, which
                evaluates several candidates side by side, collisions are checked in any case.

        Raises:
            SettingsError: x has the wrong shape.
        """
        x = self._checked(x)
        if self._kernel is None:
            outputs = self._outputs(x)
            return self._judge(x, evaluate_numpy(outputs, self.checker), outputs)
        sampled = self._kernel.evaluate(
            x, self._needs or (), with_collisions, self.threads, self._begin
        )
        return self._judge(x, sampled, sampled.outputs if self._needs else self._outputs(x))

    def carry(self, x: Array) -> Carry:
        """Return the carry of one decision vector under the task's time law.

        Args:
            x: (n_var,) decision vector.

        Raises:
            SettingsError: x has the wrong shape.
        """
        x = self._checked(x)[:1]
        outputs = self.outputs(x)
        sampled = evaluate_numpy(outputs, self.checker)
        judgement = self._judge(x, sampled, outputs).judgement(0, self.objective_names)
        single = {name: values[0] for name, values in outputs.items()}
        return carry_from_outputs(self.workcell, self.functions, x[0], single, judgement)

    def certificate(self, x: Array) -> Certificate:
        """Certify that the carry of one decision vector is free of collisions along the whole path.

        Args:
            x: (n_var,) decision vector.

        Raises:
            LostPathError: an arm cannot follow the path, on its samples or between them.
        """
        (path,) = self._paths(self._checked(x)[:1])
        if path is None:
            raise LostPathError("an arm loses the path; no more can be said of its collisions")
        (found,) = certificates(self.checker, self.functions["posture"], [path])
        if found.lost:
            place = found.at_parameter
            raise LostPathError(
                f"an arm does not follow the path between its samples, at u = {place}"
            )
        return found

    def _paths(self, x: Array) -> list[SampledPath | None]:
        """Compute the joint positions at all samples for n decision vectors.

        Args:
            x: (n, n_var) decision vectors.

        Returns:
            One sampled path for each decision vector, in order; None where an arm cannot follow the
            box.
        """
        if self._kernel is None:
            outputs: Mapping[str, Array] = self.outputs(x)
        else:
            wanted = ("q_1", "q_2", "lost_1", "lost_2")
            outputs = self._kernel.evaluate(
                x, wanted, with_collisions=False, begin=self._begin
            ).outputs
        lost = np.any((outputs["lost_1"] > 0.0) | (outputs["lost_2"] > 0.0), axis=1)
        task, q_1, q_2 = self.workcell.task, outputs["q_1"], outputs["q_2"]
        return [
            None if lost[k] else SampledPath(task, extended_waypoints(task, x[k]), q_1[k], q_2[k])
            for k in range(len(x))
        ]

    def certified(self, evaluations: Evaluations) -> Evaluations:
        """Return the evaluations, corrected such that the feasible front is proven free of
        collisions.

        The members of the front are certified along their whole paths. A member without proof
        becomes infeasible for the reason `between_samples`. Candidates that then enter the front
        are certified next, until every member has a proof.
        """
        feasible, reason = evaluations.feasible.copy(), evaluations.reason.copy()
        position, violation = evaluations.position.copy(), evaluations.violation.copy()
        proven = np.zeros(len(evaluations), dtype=bool)
        while True:
            front = non_dominated(evaluations.objectives, feasible)
            unproven = np.flatnonzero(front & ~proven)
            if len(unproven) == 0:
                break
            failures = self._failures_between_samples(evaluations.x[unproven])
            for row, failure in zip(unproven.tolist(), failures, strict=True):
                proven[row] = failure is None
                if failure is not None:
                    feasible[row], position[row] = False, failure
                    reason[row] = REASONS.index(BETWEEN_SAMPLES)
                    violation[row, reason[row]] = 1.0
        return replace(
            evaluations,
            feasible=feasible,
            reason=reason,
            position=position,
            violation=violation,
        )

    def _failures_between_samples(self, x: Array) -> list[float | None]:
        """Try to prove that each carry is free of collisions between its samples.

        Proofs are cached by path, since several carries may differ only in their force limit.

        Args:
            x: (n, n_var) decision vectors.

        Returns:
            For each decision vector the path parameter u in [0, 1] at which the proof fails; None
            if it succeeds.
        """
        paths = np.ascontiguousarray(x[:, : self.workcell.task.n_path])
        keys = [path.tobytes() for path in paths]
        new = {key: row for row, key in enumerate(keys) if key not in self._proofs}
        if new:
            sampled = self._paths(x[list(new.values())])
            followed = [path for path in sampled if path is not None]
            verdicts = iter(certificates(self.checker, self.functions["posture"], followed))
            found = [_failure(None if path is None else next(verdicts)) for path in sampled]
            if len(self._proofs) + len(new) > MOST_KNOWN:
                self._proofs = {key: self._proofs[key] for key in keys if key in self._proofs}
            self._proofs.update(zip(new, found, strict=True))
        return [self._proofs[key] for key in keys]

    def _checked(self, x: Array) -> Array:
        x = np.ascontiguousarray(np.atleast_2d(x), dtype=float)
        if x.ndim != 2 or x.shape[1] != self.n_var:
            raise SettingsError(
                f"decision vectors have shape {x.shape}; this cell needs (n, {self.n_var})"
            )
        return x

    def _judge(
        self, x: Array, sampled: SampledVerdicts, described: Mapping[str, Array]
    ) -> Evaluations:
        """Compute objectives, feasibility and penalties from the results on the samples.

        Args:
            x: (n, n_var) decision vectors.
            sampled: violations and collisions on the samples.
            described: per-sample outputs by name, at least those that the objectives read.
        """
        values = np.column_stack(
            [objective.evaluate(described, self.workcell) for objective in self.objectives]
        )
        n, n_constraints = len(x), len(CONSTRAINTS)
        violation = np.zeros((n, len(REASONS)))
        violation_time = np.zeros((n, len(REASONS)))
        violation[:, :n_constraints] = sampled.outputs["violation"]
        violation_time[:, :n_constraints] = sampled.outputs["violation_time"]
        driven = np.zeros((n, len(DRIVE_CONSTRAINTS)))
        if self.driver is not None:
            driven = described["drive_violation"]
            violation[:, -len(DRIVE_CONSTRAINTS) :] = driven
            # Paths that no timing drives violate it throughout, the more the farther from one.
            violation_time[:, -len(DRIVE_CONSTRAINTS) :] = driven / (1.0 + driven)
        judged = np.column_stack([values, violation])
        broken = np.asarray(~np.isfinite(judged).all(axis=1), dtype=np.bool_)
        shares = collision_shares(sampled.colliding & ~broken[:, None], sampled.outputs["time"])
        violation[:, n_constraints] = violation_time[:, n_constraints] = shares
        violation[broken] = violation_time[broken] = 0.0
        violation[broken, REASONS.index(NOT_FINITE)] = 1.0
        violation_time[broken, REASONS.index(NOT_FINITE)] = 1.0

        last = sampled.colliding.shape[1] - 1
        collides = sampled.colliding.any(axis=1)
        contact = np.where(collides, np.argmax(sampled.colliding, axis=1), last + 1)
        collides_first = contact < sampled.first_sample
        reason = np.where(collides_first, REASONS.index(COLLISION), sampled.first_reason)
        position = np.minimum(contact, sampled.first_sample) / last
        undriven = (reason == FEASIBLE) & driven.any(axis=1)
        if undriven.any():
            first = REASONS.index(DRIVE_CONSTRAINTS[0])
            reason[undriven] = first + np.argmax(driven[undriven], axis=1)
            position[undriven] = described["drive_position"][undriven]
        reason[broken] = REASONS.index(NOT_FINITE)
        feasible = reason == FEASIBLE
        position[broken] = 0.0
        position[feasible] = np.nan
        penalty = 1.0 + violation_time.sum(axis=1)
        penalised = np.where(feasible[:, None], values, penalty[:, None])
        return Evaluations(
            x,
            values,
            penalised,
            feasible,
            reason.astype(np.int8),
            position,
            violation,
            violation_time,
        )


def _failure(certificate: Certificate | None) -> float | None:
    """Return the path parameter u in [0, 1] at which a certificate fails.

    Args:
        certificate: the certificate; None if an arm cannot follow the path at a sample.

    Returns:
        The path parameter; 0 if an arm cannot follow the path; None for a path that is proven free.
    """
    if certificate is not None and certificate.is_free:
        return None
    return 0.0 if certificate is None or certificate.lost else certificate.at_parameter


def _needs(objectives: Sequence[Objective]) -> tuple[str, ...] | None:
    """Return the names of the per-sample outputs of the compiled kernel that objectives read.

    Args:
        objectives: the objectives.

    Returns:
        Names of outputs; None if an objective reads an output that the kernel lacks.
    """
    wanted: set[str] = set()
    for objective in objectives:
        if objective.needs is None:
            return None
        wanted |= set(objective.needs) - {"time"}
    return tuple(sorted(wanted)) if wanted <= SAMPLE_NAMES else None


class LockedEvaluator:
    """Evaluator for box paths along which every redundant joint stays at one position.

    A joint with a constant path moves the arm like a locked joint, so one compiled cell serves all
    positions. Decision vectors are the free waypoints of the box.
    """

    def __init__(self, evaluator: CandidateEvaluator, positions: Array) -> None:
        """Fix the redundant joints at the same positions along the whole path.

        Args:
            evaluator: evaluator of a cell in which redundant joints are free at all waypoints.
            positions: (m,) positions of the m redundant joints [rad or m].

        Raises:
            SettingsError: a redundant joint is fixed at a waypoint, or the number of positions is
                wrong.
        """
        task = evaluator.workcell.task
        n = len(task.waypoints)
        if evaluator.n_var != task.n_box + n * len(task.redundant):
            raise SettingsError("joints are locked in cells where they are free at every waypoint")
        if np.shape(positions) != (len(task.redundant),):
            raise SettingsError(f"{np.size(positions)} positions; needed are {len(task.redundant)}")
        self._evaluator = evaluator
        self._locked = np.repeat(np.asarray(positions, dtype=float), n)
        self.objective_names = evaluator.objective_names
        self.n_var = task.n_box
        self.lower, self.upper = evaluator.lower[: self.n_var], evaluator.upper[: self.n_var]

    def evaluate(self, x: Array) -> Evaluations:
        """Evaluate box paths with the redundant joints locked.

        Args:
            x: (n, n_var) free waypoints of the box.
        """
        return replace(self._evaluator.evaluate(self._whole(x)), x=x)

    def certified(self, evaluations: Evaluations) -> Evaluations:
        """Certify the members of the feasible front between their samples, and return corrected
        evaluations.

        Every member of the corrected front is proven free of collisions.

        Args:
            evaluations: evaluations by this evaluator.
        """
        whole = replace(evaluations, x=self._whole(evaluations.x))
        return replace(self._evaluator.certified(whole), x=evaluations.x)

    def _whole(self, x: Array) -> Array:
        return np.hstack([x, np.tile(self._locked, (len(x), 1))])
