"""Fronts: non-dominated feasible carries, made by a search and improved by a polish; and the choice
of one carry of a front.

The balanced carry has the least mean of both robots' peak normal forces. A polished front is flat
where one robot can relieve the other at no cost: the means of many points agree to five digits. Of
these points the one with the least larger peak is selected, which leaves most room for payload.
Drivable fronts include carries that hardly move and need the least force; of a drivable front the
knee is selected.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.carry import Carry, decision_of
from hybrid_opt.cell import Cell
from hybrid_opt.display_protocol import Displayable
from hybrid_opt.evaluate.evaluation import CandidateEvaluator, Evaluations
from hybrid_opt.evaluate.objectives import front_rows
from hybrid_opt.indicators import metrics
from hybrid_opt.polishing.front import PolishedFront
from hybrid_opt.polishing.settings import PolishSettings, default_settings
from hybrid_opt.progress import ShowProgress, as_callback, progress_bar
from symbolic.array import Array, set_read_only
from symbolic.errors import SettingsError

if TYPE_CHECKING:
    from hybrid_opt.metaheuristics.run import SearchSettings


@dataclass(frozen=True, eq=False, repr=False)
class Front(Displayable):
    """Non-dominated feasible carries of a cell, by increasing first objective; arrays are
    read-only.

    Every carry is proven free of collisions along its whole path, also between the samples.

    Attributes:
        cell: the cell of the carries.
        algorithm: name of the search algorithm, as 'nsga2', or another word for the origin.
        x: (k, n_var) decision vectors of the carries.
        objectives: (k, n_obj) objectives of the carries.
        evaluations: every candidate of the search, in order of evaluation.
        polished: record of the polish, None for a front that was not polished.
        replica: number of the replica in its study, from 0; None outside of studies.
    """

    cell: Cell
    algorithm: str
    x: Array
    objectives: Array
    evaluations: Evaluations
    polished: PolishedFront | None = None
    replica: int | None = None

    def __post_init__(self) -> None:
        set_read_only(self)

    @classmethod
    def of_search(
        cls, cell: Cell, algorithm: str, evaluations: Evaluations, replica: int | None = None
    ) -> Front:
        """Return the front of a search's evaluations.

        Args:
            cell: the cell that was searched.
            algorithm: name of the search algorithm.
            evaluations: all candidates, already processed by `CandidateEvaluator.certified`.
            replica: number of the replica in its study, None outside of studies.
        """
        rows = front_rows(evaluations.objectives, evaluations.feasible)
        x, objectives = evaluations.x[rows], evaluations.objectives[rows]
        return cls(cell, algorithm, x, objectives, evaluations, replica=replica)

    @classmethod
    def of(cls, cell: Cell, x: Array) -> Front:
        """Evaluate feasible, collision-free carries and return them as a front.

        Args:
            cell: the cell of the carries.
            x: (k, n_var) decision vectors by increasing first objective.

        Raises:
            SettingsError: x has the wrong shape.
        """
        found = cell.evaluate(x)
        return cls(cell, "given", found.x, found.objectives, found)

    def after(self, polish: PolishedFront) -> Front:
        """Return this front with its carries replaced by the polished ones.

        Args:
            polish: result of the polish of this front.
        """
        return replace(self, x=polish.x, objectives=polish.objectives, polished=polish)

    @property
    def key(self) -> tuple[str, int]:
        """Algorithm name and replica number; the number is 0 for a front outside of studies."""
        return self.algorithm, self.replica or 0

    @property
    def title(self) -> str:
        """Title of the algorithm, followed by ', polished' for a polished front."""
        # Not imported at the top: the searches take long to load.
        from hybrid_opt.metaheuristics.run import title

        return title(self.algorithm) + ("" if self.polished is None else ", polished")

    @property
    def source(self) -> str:
        """Title of the front, followed by the replica number for a front of a study."""
        return self.title if self.replica is None else f"{self.title}, replica {self.replica}"

    @property
    def objective_names(self) -> tuple[str, ...]:
        """Names of the n_obj objectives, in the order of the columns of `objectives`."""
        return self.cell.objective_names

    def __len__(self) -> int:
        return len(self.x)

    def __getitem__(self, index: int) -> Carry:
        """Return the carry at an index of the front, with every physical quantity."""
        return self.cell.carry(self.x[index])

    def __iter__(self) -> Iterator[Carry]:
        return (self[index] for index in range(len(self)))

    def balanced(self) -> Carry:
        """Return the carry with the least mean of the two robots' peak normal forces.

        Means whose relative difference is below `TIE` count as equal. Of carries with equal means,
        the one with the smallest maximum of both peaks is returned.

        Raises:
            SettingsError: the front is empty.
        """
        return self[balanced(self._peaks())]

    def lowest_force(self, robot: int) -> Carry:
        """Return the carry with the least peak normal force of one robot.

        Args:
            robot: index of the robot, 0 or 1.

        Raises:
            SettingsError: the front is empty, or there is no such robot.
        """
        if robot not in (0, 1):
            raise SettingsError(f"robot {robot!r}; allowed are 0 and 1", code="robot")
        return self[int(np.argmin(self._peaks()[:, robot]))]

    def lowest(self, objective: str) -> Carry:
        """Return the carry with the least value of one objective.

        Args:
            objective: name of the objective, one of `objective_names`.

        Raises:
            SettingsError: the front is empty, or was not searched for that objective.
        """
        if objective not in self.objective_names:
            raise SettingsError(
                f"objective {objective!r}; this front has {', '.join(self.objective_names)}",
                code="unknown-objective",
            )
        self._require_members()
        return self[int(np.argmin(self.objectives[:, self.objective_names.index(objective)]))]

    def hypervolume(self, reference: Array | None = None) -> float:
        """Compute the hypervolume of the objectives that the front dominates.

        Args:
            reference: (n_obj,) reference point, None for the paper's 1.1 in each objective.
        """
        point = metrics.reference_point(len(self.objective_names))
        return metrics.hypervolume(self.objectives, point if reference is None else reference)

    def spacing(self) -> float:
        """Compute the standard deviation of the distances between nearest neighbours on the front,
        in objective space; 0 for an evenly spaced front.
        """
        return metrics.spacing(self.objectives)

    def _peaks(self) -> Array:
        self._require_members()
        return peak_normal_forces(self.cell.evaluator, self.x)

    def _require_members(self) -> None:
        if len(self) == 0:
            raise SettingsError(
                "the front is empty: no feasible candidate was found; give the search more "
                "evaluations or the task wider bounds",
                code="empty-front",
            )


# --- how fronts are made ---


def search(
    cell: Cell,
    algorithm: str = "nsga2",
    *,
    evaluations: int = 1000,
    rng: np.random.Generator,
    settings: SearchSettings | None = None,
    progress: ShowProgress = False,
) -> Front:
    """Search for non-dominated carries and return them as a front.

    Args:
        cell: the cell to search.
        algorithm: name of the search algorithm, one of `algorithms()`.
        evaluations: largest number of candidates to evaluate.
        rng: random generator; the same state gives exactly the same front.
        settings: settings of the search, None for the defaults. Without initial candidates in
            the settings, the first generation contains the cell's hand-made trajectory, except
            in the random search.
        progress: True for a progress bar, or a function that is called with the number of
            candidates evaluated and their total.

    Raises:
        SettingsError: an unknown algorithm or a value that is not allowed.
        WorkcellError: the payload cannot be held still, so that there is nothing to search for.
    """
    # Not imported at the top: the searches take long to load.
    from hybrid_opt.metaheuristics.run import SearchSettings, make, search_carries

    settings = settings or SearchSettings()
    make(algorithm, settings.algorithm)  # refuses mistakes before anything is compiled
    evaluator = cell.holding_evaluator
    if settings.initial is None and algorithm != "random":
        settings = replace(settings, initial=cell.initial[None])
    with progress_bar(progress, algorithm, evaluations) as advance:
        found, _ = search_carries(
            evaluator, algorithm, evaluations, rng, settings, advance, cell.workcell.task
        )
    return Front.of_search(cell, algorithm, found)


def polish(
    front: Front,
    *,
    rng: np.random.Generator,
    settings: PolishSettings | None = None,
    paths: Sequence[Carry | Array] = (),
    progress: ShowProgress = False,
) -> Front:
    """Improve the carries of a front by nonlinear programming and return the polished front.

    The polish lowers both peak normal forces. In drivable cells, whose carries are timed from rest
    to rest within all limits, it lowers duration and force instead, by optimising path and speed
    profile together. It makes many attempts: solves from different starts that improve points of
    the front or fill its gaps.

    Args:
        front: the front to improve.
        rng: random generator of those starts that are chosen at random.
        settings: settings of the polish, None for the defaults of the cell's time law.
        paths: further good carries of the same cell from which attempts start, or their decision
            vectors (n_var,), or (n_path,) without the force limit; only for drivable cells. No
            given path dominates a point of the result. The hand-made path is always a start.
        progress: True for a progress bar, or a function that is called with the number of attempts
            done and the number expected in all; the second number may change.

    Raises:
        SettingsError: the polish does not support the cell's objectives, or a path does not fit.
    """
    # Not imported at the top: solvers take long to load.
    from hybrid_opt.polishing.polisher import make_polisher

    cell, task = front.cell, front.cell.workcell.task
    settings = settings or default_settings(task.law.is_drivable)
    polisher = make_polisher(cell.evaluator, settings, cell.polish_functions)
    known = [np.asarray(decision_of(path), dtype=float) for path in paths]
    if known and not task.law.is_drivable:
        raise SettingsError(
            f"known paths take part in polishes of drivable carries only; this one has "
            f"{task.law.title}: polish the front of Cell.drivable()"
        )
    for path in known:
        if path.shape not in ((task.n_path,), (task.n_var,)) or not np.isfinite(path).all():
            raise SettingsError(
                f"a known path of shape {path.shape}; needs {task.n_path} finite numbers, or "
                f"{task.n_var} with a force limit"
            )
    beside = np.array([path[: task.n_path] for path in known]).reshape(-1, task.n_path)
    with progress_bar(progress, "polish", settings.attempts) as advance:
        done = polisher.polish(front.x, rng, paths=beside, on_progress=as_callback(advance))
    return front.after(done)


# --- the choice of one carry ---


TIE = 3e-4
"""Relative difference below which two mean forces count as equal: 15 mN on the rack cell."""

_CHUNK = 256
"""Candidates evaluated at once; every sample of each is held in memory."""


@dataclass(frozen=True)
class SelectedCarry:
    """The carry selected from a front.

    Attributes:
        row: index of the carry among all evaluations of the search; for a polished front, its index
            in the front.
        carry: the selected carry under the task's time law, with its judgement.
    """

    row: int
    carry: Carry

    @property
    def objectives(self) -> Array:
        """(n_obj,) objective values of the carry, without penalty."""
        assert self.carry.judgement is not None
        return np.array(list(self.carry.judgement.objectives.values()))


def balanced(peak_normal_force: Array) -> int:
    """Return the index of the carry with the least mean of both robots' peak normal forces.

    Means whose relative difference is below `TIE` count as equal. Of carries with equal means, the
    one with the smallest maximum of both peaks is chosen.

    Args:
        peak_normal_force: (k, 2) peak normal force of each robot in k carries [N].
    """
    mean = peak_normal_force.mean(axis=1)
    equal = mean <= mean.min() * (1.0 + TIE)
    return int(np.argmin(np.where(equal, peak_normal_force.max(axis=1), np.inf)))


def knee(points: Array) -> int:
    """Return the index of the point with the least product of its two objectives.

    Near this point a rise of one objective by one per cent lowers the other by at most one per
    cent. The distance from the line between the front's ends (Das 1999) is not used, because it
    depends on how far the ends were explored.

    Args:
        points: (k, 2) positive objectives of the points.

    Raises:
        SettingsError: there are no points, or an objective is not positive.
    """
    points = np.asarray(points, dtype=float)
    if len(points) == 0:
        raise SettingsError("the front is empty: it has no knee", code="empty-front")
    if not (points > 0.0).all():
        raise SettingsError("the knee needs objectives above zero", code="not-positive")
    return int(np.argmin(np.log(points).sum(axis=1)))


def select(
    evaluator: CandidateEvaluator, x: Array, rows: NDArray[np.intp] | None = None
) -> SelectedCarry | None:
    """Compute the selected carry of a front, as `selected_row` chooses it; None for an empty front.

    Args:
        evaluator: evaluator of the cell's candidates.
        x: (k, n_var) decision vectors of the front.
        rows: (k,) index of each carry, for `SelectedCarry.row`; None for 0 to k - 1.
    """
    if len(x) == 0:
        return None
    index = selected_row(evaluator, x)
    row = index if rows is None else int(rows[index])
    return SelectedCarry(row, evaluator.carry(x[index]))


def selected_row(evaluator: CandidateEvaluator, x: Array) -> int:
    """Return the index of the selected carry of a front.

    The balanced carry is selected. In drivable cells, whose carries are timed from rest to rest
    within all limits, it is the knee of duration and larger peak force.

    Args:
        evaluator: evaluator of the cell's candidates.
        x: (k, n_var) decision vectors of the front, k > 0.
    """
    peaks, durations = _peaks_and_durations(evaluator, x)
    if not evaluator.workcell.task.law.is_drivable:
        return balanced(peaks)
    return knee(np.column_stack([durations, peaks.max(axis=1)]))


def peak_normal_forces(evaluator: CandidateEvaluator, x: Array) -> Array:
    """Compute the peak normal force (n, 2) of each robot [N] along n carries.

    Args:
        evaluator: evaluator of the cell's candidates.
        x: (n, n_var) decision vectors of the carries.
    """
    return _peaks_and_durations(evaluator, x)[0]


def _peaks_and_durations(evaluator: CandidateEvaluator, x: Array) -> tuple[Array, Array]:
    """Compute peak normal forces (n, 2) of both robots [N] and durations (n,) [s] of n carries.

    Args:
        evaluator: evaluator of the cell's candidates.
        x: (n, n_var) decision vectors of the carries.
    """
    peaks, durations = [], []
    for begin in range(0, len(x), _CHUNK):
        outputs = evaluator.outputs(x[begin : begin + _CHUNK])
        peaks.append(outputs["normal_force"].max(axis=1))
        durations.append(outputs["time"][:, -1])
    return np.concatenate(peaks), np.concatenate(durations)
