"""Sweep over numbers of a cell: duration and force of its recommended carry for every combination.

The carry of a combination has the path of its neighbour, polished in the changed cell, or one fixed
path. Combinations that differ in the last key alone are neighbours, computed one after the other.
The path of the unchanged cell is tried for every combination, so that a combination that hardly
holds does not mislead its neighbours.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from codegen.cache import digest
from hybrid_opt.carry import Carry
from hybrid_opt.cell import Cell
from hybrid_opt.evaluate.evaluation import Evaluations
from hybrid_opt.front import Front, polish
from hybrid_opt.polishing.settings import DrivableSettings, PolishSettings
from hybrid_opt.progress import ShowProgress, progress_bar
from hybrid_opt.recommending.choice import (
    DrivenPaths,
    Goal,
    Wish,
    best_of_paths,
    force_alone,
    ranked,
)
from hybrid_opt.recommending.recommendation import recommend
from hybrid_opt.store.files import read_record, to_json, write_json
from hybrid_opt.workers import LocalWorkers
from symbolic.array import Array, Figure, Row
from symbolic.errors import DualArmError, SettingsError

POLISH = PolishSettings(attempts=8, drivable=DrivableSettings(first_rounds=12, members=4))
"""Polish of a path that was the best one of a nearby cell."""

_OTHER_FILE = "remove it, or name another file"


@dataclass(frozen=True)
class Combination:
    """Recommended carry of a cell with one combination of changed values.

    Attributes:
        values: the changed values, in the order of the sweep's keys.
        duration: duration of the carry [s]; NaN if there is no carry.
        force: largest commanded normal force of the carry [N]; NaN if there is no carry.
        x: (n_var,) decision vector of the carry; empty if there is no carry.
        remark: reason why there is no carry, or an objection to the carry.
    """

    values: tuple[float, ...]
    duration: Figure
    force: Figure
    x: Row
    remark: str = ""


@dataclass(frozen=True)
class Sweep:
    """Result of a sweep: one row for each combination of values, as stored.

    Attributes:
        about: digest of the cell, its objectives, and whether the path is fixed.
        over: values of each key that are combined.
        x: (n_var,) decision vector of a good carry of the unchanged cell, where each combination
            starts.
        rows: results of the finished combinations; the last key varies fastest.
    """

    about: str
    over: Mapping[str, tuple[float, ...]]
    x: Row
    rows: tuple[Combination, ...] = ()

    def __repr__(self) -> str:
        return "\n".join([f"Sweep over {' and '.join(self.over)}:", *map(self._line, self.rows)])

    def _line(self, row: Combination) -> str:
        named = zip(self.over, row.values, strict=True)
        found = [f"{row.duration:.3f} s, press with {row.force:.1f} N"] if len(row.x) else []
        said = "; ".join(found + ([row.remark] if row.remark else []))
        return f"  {', '.join(f'{key} {value:g}' for key, value in named)}: {said}"


def read_sweep(file: Path) -> Sweep:
    """Read a stored sweep.

    Args:
        file: path of the file.

    Raises:
        ResultsError: the file cannot be read or is damaged.
    """
    return read_record(Sweep, file, _OTHER_FILE)


def require_keys(cell: Cell, over: Mapping[str, Sequence[float]]) -> None:
    """Check, before any work, that a cell has the keys of a sweep.

    Args:
        cell: the cell.
        over: values of each key that are combined.

    Raises:
        SettingsError: there are no values.
        WorkcellError: a key does not exist.
    """
    if not over or not all(map(len, over.values())):
        raise SettingsError("a sweep needs keys, and values of each", code="no-values")
    cell.changed({key: each[0] for key, each in over.items()})


def sweep(
    cell: Cell,
    path: Carry | Array,
    over: Mapping[str, Sequence[float]],
    *,
    fixed: bool = False,
    file: str | Path | None = None,
    jobs: int = 1,
    progress: ShowProgress = False,
) -> Sweep:
    """Compute duration and commanded force of the recommended carry for every combination of values
    of a cell.

    Args:
        cell: drivable cell, whose carries are timed from rest to rest within all limits
            (`Cell.drivable`).
        path: good carry of the cell, such as the recommended one, or the carry's decision vector.
        over: values to combine, by key path as for `Cell.changed`.
        fixed: True to keep the path and to choose only its force limit anew; False to polish the
            path in every changed cell.
        file: file that stores finished combinations, to resume the sweep; None for no file.
        jobs: number of worker processes, 0 for one per core; has no influence on the result.
        progress: True for a progress bar, or a function that is called with the number of finished
            combinations and their total.

    Raises:
        SettingsError: the cell is not drivable, the path does not fit it, there are no values, or
            the file has the sweep of another cell or other values.
        WorkcellError: the cell has no such key.
    """
    x = np.asarray(path.x if isinstance(path, Carry) else path, dtype=float)
    if not cell.workcell.task.law.is_drivable or x.shape != (cell.n_var,):
        raise SettingsError(
            f"a sweep takes a drivable cell (Cell.drivable) and a carry of it; the time law is "
            f"{cell.workcell.task.law.name!r}, the path has shape {x.shape} of ({cell.n_var},)",
            code="not-drivable",
        )
    values = {key: tuple(map(float, each)) for key, each in over.items()}
    require_keys(cell, values)
    about = digest(cell.workcell.digest, *cell.objective_names, str(fixed))
    known, file = Sweep(about, values, x), None if file is None else Path(file)
    if file is not None and file.exists():
        known = read_sweep(file)
        if (known.about, dict(known.over)) != (about, values):
            raise SettingsError(
                f"{file} holds the sweep of another cell, or over other values: {_OTHER_FILE}",
                code="another-sweep",
            )
    chains = _Chains(known, file)
    with progress_bar(progress, "sweep", chains.size) as advance, LocalWorkers(jobs) as workers:
        advance(len(chains.done))
        call = partial(_next_row, _Request(cell, known.x, fixed, tuple(values)))

        def store(index: int, row: Combination) -> None:
            chains.store(row)
            advance(1)

        for column in chains.columns:
            left = [(values, chains.near(values)) for values in chains.left(column)]
            workers.map(call, left, store)
    return chains.sweep


class _Chains:
    """Combinations of a sweep with their results so far, arranged in chains. In a chain only the
    value of the last key varies.

    Attributes:
        sweep: the results in the order of the sweep.
        size: number of all combinations.
        columns: values of the last key.
        done: results by the values of their combinations.
    """

    def __init__(self, known: Sweep, file: Path | None) -> None:
        self.sweep, self._file = known, file
        *outer, self.columns = known.over.values()
        self._heads = list(product(*outer))
        self.size = len(self._heads) * len(self.columns)
        self.done = {row.values: row for row in known.rows}
        self._write()

    def left(self, column: float) -> list[tuple[float, ...]]:
        """Return the unfinished combinations whose last key has a given value.

        Args:
            column: value of the last key.

        Returns:
            The values of all keys, for each combination.
        """
        every = [(*head, column) for head in self._heads]
        return [values for values in every if values not in self.done]

    def near(self, values: tuple[float, ...]) -> Array | None:
        """Return the carry of a finished combination that is similar to a given one, as a start for
        it.

        Only the value of the last key differs. Of the values that stand before the given one in the
        list of this key, the nearest one in the list whose combination has a carry is taken.

        Args:
            values: values of the given combination, in the order of the keys.

        Returns:
            (n_var,) decision vector of the carry; None if there is none.
        """
        *head, last = values
        for value in reversed(self.columns[: self.columns.index(last)]):
            if len(x := self.done[*head, value].x):
                return x
        return None

    def store(self, row: Combination) -> None:
        """Add the result of a combination, and write the file of the sweep.

        Args:
            row: the result.
        """
        self.done[row.values] = row
        self._write()

    def _write(self) -> None:
        order = [values for values in product(*self.sweep.over.values()) if values in self.done]
        rows = tuple(self.done[values] for values in order)
        self.sweep = replace(self.sweep, rows=rows)
        if self._file is not None:
            write_json(self._file, to_json(self.sweep))


@dataclass(frozen=True)
class _Request:
    """Data that all combinations of a sweep share.

    Attributes:
        cell: the unchanged cell.
        x: (n_var,) decision vector of a good carry of the unchanged cell.
        fixed: True if the path is kept.
        keys: keys whose values are changed.
    """

    cell: Cell
    x: Array
    fixed: bool
    keys: tuple[str, ...]


_LOADED: dict[tuple[Any, ...], Cell] = {}
"""The cell of the last sweep of this process, by its digest and objectives."""


def _loaded(cell: Cell) -> Cell:
    """Return a cell whose functions are already loaded, if an earlier call in this process was
    given an equal cell; otherwise the given cell.

    Args:
        cell: the cell.
    """
    key = cell.workcell.digest, *cell.objectives
    if key not in _LOADED:
        _LOADED.clear()
        _LOADED[key] = cell
    return _LOADED[key]


def _next_row(
    request: _Request, combination: tuple[tuple[float, ...], Array | None]
) -> Combination:
    """Compute the result of one combination of numbers of the workcell file.

    Args:
        request: what all combinations share, such as the unchanged cell and the keys of the
            numbers.
        combination: the numbers, in the order of the request's keys; and the decision vector
            (n_var,) of the carry of a similar combination, None without one.
    """
    numbers, near = combination
    known = [request.x] if near is None or request.fixed else [request.x, near]
    values = dict(zip(request.keys, numbers, strict=True))
    return _row(_loaded(request.cell), values, known, request.fixed)


def _row(
    cell: Cell, values: Mapping[str, float], near: Sequence[Array], fixed: bool
) -> Combination:
    numbers = tuple(values.values())
    try:
        changed = cell.changed(values)
        changed.require_hold()
        front = Front.of_search(changed, "neighbour", _tried(changed, near, fixed))
        if not fixed and len(front):
            front = polish(front, rng=np.random.default_rng(0), settings=POLISH)
        found = recommend(front, alone=True)
    except DualArmError as error:
        return Combination(
            numbers, np.nan, np.nan, np.zeros(0), str(error).splitlines()[-1].strip()
        )
    best = np.append(front.x[found.member, :-1], found.limit)
    told = "; ".join([*([] if found.fits else [found.objection]), *found.warnings])
    return Combination(numbers, found.duration, found.force, best, told)


def _tried(cell: Cell, near: Sequence[Array], fixed: bool) -> Evaluations:
    """Evaluate paths in a changed cell, each with the best of several force limits.

    A limit is admissible for a path if the robust force of each robot is then at most the robot's
    reference force. The admissible limit with the least product of duration and commanded force is
    taken; a path without an admissible limit is left out. If no path has one, every path that can
    be timed is evaluated, with the limit of the least commanded force.

    Args:
        cell: the changed cell.
        near: decision vectors (n_var,) of the paths; their own force limits are not used.
        fixed: True to evaluate only these paths; False to evaluate the hand-made path too.

    Returns:
        Evaluations of the paths. The members of their feasible front are certified between the
        samples.
    """
    x = np.array([x[:-1] for x in (near if fixed else [*near, cell.initial])])
    paths = DrivenPaths(cell, x)
    options = paths.all_options(cell.workcell.task.force_limit[1])
    goal = Goal.of(Wish(), cell.workcell)
    if not ranked(options, goal):
        goal = replace(goal, hardest=np.full(2, np.inf), cost=force_alone)
    best = best_of_paths(paths, options, goal, len(x))
    tried = [np.append(x[option.index], option.limit) for option in best]
    return cell.evaluator.certified(cell.evaluate(np.reshape(tried, (-1, cell.n_var))))
