"""What other numbers of a cell would do to its carry: duration and force for every combination.

Of each combination the carry that is recommended is asked for: the path of its neighbour, polished
in the changed cell, or one path that stays as it is. Combinations that differ in the last key alone
are neighbours: one worker goes through them. The path of the cell as it is takes part everywhere,
so that a combination which hardly holds does not lead its neighbours astray.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from codegen.cache import digest
from hybrid_opt.carry import Carry
from hybrid_opt.cell import Cell
from hybrid_opt.door import polish
from hybrid_opt.evaluate.evaluation import Evaluations
from hybrid_opt.evaluate.objectives import Objective
from hybrid_opt.front import Front
from hybrid_opt.polishing.settings import DrivableSettings, PolishSettings
from hybrid_opt.progress import ShowProgress, counted
from hybrid_opt.recommending.choice import (
    DrivenPaths,
    Goal,
    Wish,
    best_of_paths,
    force_alone,
    ranked,
)
from hybrid_opt.recommending.recommendation import recommend
from hybrid_opt.store.files import from_json, read_record, to_json, write_json
from hybrid_opt.work.service import Emit, LocalExecutor, Service, give_up
from symbolic.array import Array, Figure, Row
from symbolic.errors import DualArmError, SettingsError
from symbolic.records import Workcell

POLISH = PolishSettings(attempts=8, drivable=DrivableSettings(first_rounds=12, members=4))
"""Polish of a path that was the best one of a nearby cell."""

_OTHER_FILE = "remove it, or name another file"


@dataclass(frozen=True)
class Combination:
    """The carry of one combination of numbers.

    Attributes:
        values: by key, in the order of the sweep.
        duration: of the carry as robots drive it [s]; NaN where there is none.
        force: the largest to be commanded [N]; likewise.
        x: (n_var,) its decision vector, or () where there is none.
        remark: why there is none, or what speaks against it.
    """

    values: tuple[float, ...]
    duration: Figure
    force: Figure
    x: Row
    remark: str = ""


@dataclass(frozen=True)
class Sweep:
    """What a sweep found, and what is stored of it.

    Attributes:
        about: digest of the cell, of what it minimises, and of whether the path is fixed.
        over: the values of every key.
        x: (n_var,) where all begin.
        rows: combinations that are done, the last key fastest.
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


def stored_sweep(file: Path) -> Sweep:
    """What a file holds of a sweep.

    Raises:
        ResultsError: it cannot be read or is damaged.
    """
    return read_record(Sweep, file, _OTHER_FILE)


def require_keys(cell: Cell, over: Mapping[str, Sequence[float]]) -> None:
    """Refuse a sweep over what a cell does not have, before any work.

    Raises:
        SettingsError, WorkcellError: as of `sweep`.
    """
    if not over or not all(map(len, over.values())):
        raise SettingsError("a sweep needs keys, and values of each")
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
    """The recommended carry's duration and force for every combination of some numbers of a cell.

    Args:
        cell: under the time law 'optimal', see `Cell.drivable`.
        path: a good carry of the cell, such as the recommended one, or its decision vector.
        over: values by key path, see `Cell.changed`.
        fixed: whether the path stays as it is; otherwise it is polished in every changed cell.
        file: where combinations are stored as they are done, and are found again; None for none.
        jobs: worker processes, 0 for one per core; has no influence on the answer.
        progress: True for a bar, or what takes combinations done and in all.

    Raises:
        SettingsError: the cell has another time law, the path does not fit it, there are no values,
            or the file is about something else.
        WorkcellError: a key leads nowhere.
    """
    x = np.asarray(path.x if isinstance(path, Carry) else path, dtype=float)
    if cell.workcell.task.time_law != "optimal" or x.shape != (cell.n_var,):
        raise SettingsError(
            f"a sweep takes a drivable cell (Cell.drivable) and a carry of it; the time law is "
            f"{cell.workcell.task.time_law!r}, the path has shape {x.shape} of ({cell.n_var},)"
        )
    values = {key: tuple(map(float, each)) for key, each in over.items()}
    require_keys(cell, values)
    about = digest(cell.workcell.digest, *cell.objective_names, str(fixed))
    known, file = Sweep(about, values, x), None if file is None else Path(file)
    if file is not None and file.exists():
        known = stored_sweep(file)
        if (known.about, dict(known.over)) != (about, values):
            raise SettingsError(
                f"{file} holds the sweep of another cell, or over other values: {_OTHER_FILE}"
            )
    with counted(progress, "sweep", len(list(product(*values.values())))) as advance:
        ledger = _Chains(known, file, advance)
        context = partial(_context, cell.workcell, tuple(cell.objectives), known.x, fixed)
        if len(ledger):
            LocalExecutor(jobs).run(Service(context, _walk), ledger)
    return ledger.sweep


class _Chains:
    """A ledger: chains of combinations, each with those of it that are done."""

    def __init__(self, known: Sweep, file: Path | None, advance: Callable[[int], None]) -> None:
        self.sweep, self._file, self._advance = known, file, advance
        *outer, self._last = known.over.values()
        self._done = {row.values: row for row in known.rows}
        self._advance(len(self._done))
        every = [tuple((*head, last) for last in self._last) for head in product(*outer)]
        self._open = [chain for chain in every if not self._done.keys() >= set(chain)]
        self._store()

    def __len__(self) -> int:
        return len(self._open)

    def request(self, index: int) -> tuple[tuple[str, ...], tuple[Any, ...]]:
        """The keys, and per combination of a chain its values or its row."""
        chain = self._open[index]
        return tuple(self.sweep.over), tuple(self._done.get(values, values) for values in chain)

    def heard(self, index: int, message: bytes) -> None:
        """Store a row."""
        row = from_json(Combination, json.loads(message), "a worker", "run it again")
        self._done[row.values] = row
        self._advance(1)
        self._store()

    def answered(self, index: int, answer: None) -> None:
        """All of its rows were told."""

    def lost(self, index: int, reason: str) -> None:
        """End the sweep; what is done is kept."""
        give_up(reason)

    def _store(self) -> None:
        order = [values for values in product(*self.sweep.over.values()) if values in self._done]
        rows = tuple(self._done[values] for values in order)
        self.sweep = Sweep(self.sweep.about, self.sweep.over, self.sweep.x, rows)
        if self._file is not None:
            write_json(self._file, to_json(self.sweep))


def _context(
    workcell: Workcell, objectives: tuple[str | Objective, ...], x: Array, fixed: bool
) -> tuple[Cell, Array, bool]:
    return Cell(workcell, objectives), x, fixed


def _walk(context: tuple[Cell, Array, bool], request: Any, emit: Emit) -> None:
    """The rows of a chain, each from the one before it that has a carry."""
    cell, x, fixed = context
    keys, chain = request
    near = [x]
    for each in chain:
        row = each
        if not isinstance(row, Combination):
            row = _row(cell, dict(zip(keys, each, strict=True)), near, fixed)
            emit(json.dumps(to_json(row)).encode())
        if len(row.x) and not fixed:
            near = [x, row.x]


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
    """Verdicts on paths, and on the hand-made one where they may change, each within the limit that
    suits it best."""
    x = np.array([x[:-1] for x in (near if fixed else [*near, cell.initial])])
    paths = DrivenPaths(cell, x)
    options = paths.all_options(cell.workcell.task.force_limit[1])
    goal = Goal.of(Wish(), cell.workcell)
    if not ranked(options, goal):
        goal = replace(goal, hardest=np.full(2, np.inf), cost=force_alone)
    best = best_of_paths(paths, options, goal, len(x))
    tried = [np.append(x[option.index], option.limit) for option in best]
    return cell.evaluator.certified(cell.evaluate(np.reshape(tried, (-1, cell.n_var))))
