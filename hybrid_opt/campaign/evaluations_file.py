"""Evaluated candidates as compressed CSV. docs/results.md describes the columns.

Numbers are written with the fewest digits that give the same bits when read back.
"""

from __future__ import annotations

import gzip
import io
import zlib
from array import array
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.errors import ResultsError
from hybrid_opt.evaluate.evaluations import FEASIBLE, REASONS, Evaluations
from hybrid_opt.store.files import csv_text
from symbolic.array import Array

_LEVEL = 4
_FIXED = ("evaluation", "generation", "feasible", "reason", "position")
_REASON = _FIXED.index("reason")
_LONGEST_LINE = 1_000_000

_ROOM = 2**24
_BYTES_PER_NUMBER = 2
"""A file may hold `_ROOM` numbers, and one more per `_BYTES_PER_NUMBER` of its bytes. Zeros can be
packed much tighter, but evaluated candidates hold more digits than zeros."""


@dataclass(frozen=True)
class EvaluationTable:
    """The content of a file of evaluated candidates.

    Attributes:
        evaluations: every candidate in the order of evaluation.
        generation: (n,) number of the generation of each, from 1.
        objective_names: of the columns of the objectives.
    """

    evaluations: Evaluations
    generation: NDArray[np.int64]
    objective_names: tuple[str, ...]


def columns(
    n_var: int, objective_names: tuple[str, ...], reasons: tuple[str, ...] = REASONS
) -> list[str]:
    """The names of all columns."""
    return [
        *_FIXED,
        *(f"x_{k + 1}" for k in range(n_var)),
        *(f"objective_{name}" for name in objective_names),
        *(f"penalised_{name}" for name in objective_names),
        *(f"violation_{reason}" for reason in reasons),
        *(f"violation_time_{reason}" for reason in reasons),
    ]


def encode(table: EvaluationTable) -> bytes:
    """The content of the file; the same table always gives the same bytes."""
    found = table.evaluations
    words = {FEASIBLE: "", **dict(enumerate(REASONS))}
    numbers = np.column_stack(
        [found.x, found.objectives, found.penalised, found.violation, found.violation_time]
    ).tolist()
    lines = [",".join(columns(found.x.shape[1], table.objective_names))]
    for index, (generation, feasible, reason, position, row) in enumerate(
        zip(
            table.generation.tolist(),
            found.feasible.tolist(),
            found.reason.tolist(),
            found.position.tolist(),
            numbers,
            strict=True,
        ),
        1,
    ):
        head = f"{index},{generation},{int(feasible)},{words[reason]},{position!r},"
        lines.append(head + ",".join(map(repr, row)))
    return gzip.compress(("\n".join(lines) + "\n").encode(), _LEVEL, mtime=0)


def decode(content: bytes, path: Path) -> EvaluationTable:
    """The candidates in a file's content.

    Args:
        content: as from `encode`.
        path: named in messages.

    Raises:
        ResultsError: the content is damaged.
    """
    try:
        with gzip.open(io.BytesIO(content)) as file:
            names = _text(file.readline(_LONGEST_LINE)).split(",")
            objectives = _between(names, "objective_")
            n_var, n_obj = len(_between(names, "x_")), len(objectives)
            # Reasons are only ever added, at the end: older files have the first of them.
            stored = REASONS[: len(_between(names, "violation_time_"))]
            if names != columns(n_var, objectives, stored):
                raise ValueError("its columns are not those of this version")
            most = _ROOM + len(content) // _BYTES_PER_NUMBER
            values, reason = _rows(file, len(names), most)
        _, generation, feasible, position = values[:, :4].T
        _check(values, generation, feasible, values[:, 4 : 4 + n_var])
    except (OSError, EOFError, zlib.error, ValueError, KeyError, IndexError) as error:
        raise ResultsError(f"{path}: damaged ({error})") from error
    widths = np.cumsum([n_var, n_obj, n_obj, len(stored), len(stored)])
    x, plain, penalised, *violations, _ = np.split(values[:, 4:], widths, axis=1)
    missing = ((0, 0), (0, len(REASONS) - len(stored)))
    violation, violation_time = (np.pad(part, missing) for part in violations)
    return EvaluationTable(
        Evaluations(
            x, plain, penalised, feasible == 1.0, reason, position, violation, violation_time
        ),
        generation.astype(np.int64),
        objectives,
    )


def _text(line: bytes) -> str:
    if len(line) == _LONGEST_LINE:
        raise ValueError(f"a line of more than {_LONGEST_LINE} characters")
    return line.decode("ascii").rstrip("\n")


def _rows(file: gzip.GzipFile, width: int, most: int) -> tuple[Array, NDArray[np.int8]]:
    """Numbers (n, width - 1) and reasons (n,) of all rows.

    Row by row, so that no more is held than what is kept, and a small file cannot unfold into a
    huge one: each row bears its number, and there are not more than `most` numbers.
    """
    reasons = {"": FEASIBLE, **{reason: k for k, reason in enumerate(REASONS)}}
    numbers, found = array("d"), array("b")
    while line := file.readline(_LONGEST_LINE):
        words = _text(line).split(",")
        if words[0] != str(len(found) + 1):
            raise ValueError("candidates are missing or out of order")
        if len(words) != width:
            raise ValueError(f"candidate {words[0]} has {len(words)} columns of {width}")
        if len(numbers) + width > most:
            raise ValueError(f"it holds more than {most} numbers, too many for its size")
        found.append(reasons[words.pop(_REASON)])
        numbers.extend(map(float, words))
    return (
        np.frombuffer(numbers, dtype=float).reshape(-1, width - 1),
        np.frombuffer(found, dtype=np.int8),
    )


def _check(values: Array, generation: Array, feasible: Array, x: Array) -> None:
    if not len(values):
        raise ValueError("it holds no candidates")
    if not np.isfinite(x).all():
        raise ValueError("a decision vector is not finite")
    if not np.isin(feasible, (0.0, 1.0)).all():
        raise ValueError("the column feasible holds other than 0 and 1")
    whole = np.isfinite(generation) & (generation == np.round(generation))
    if not np.all(whole & (generation >= 1.0) & (generation <= len(values))):
        raise ValueError("the column generation holds other than numbers of generations")


def encode_front(table: EvaluationTable, rows: NDArray[np.intp]) -> bytes:
    """Some candidates as plain CSV: evaluation, objectives and decision vector."""
    found = table.evaluations
    names = [*table.objective_names, *(f"x_{k + 1}" for k in range(found.x.shape[1]))]
    numbers = np.hstack([found.objectives[rows], found.x[rows]]).tolist()
    numbered = ([row + 1, *values] for row, values in zip(rows.tolist(), numbers, strict=True))
    return csv_text(["evaluation", *names], numbered).encode()


def _between(names: list[str], prefix: str) -> tuple[str, ...]:
    return tuple(name.removeprefix(prefix) for name in names if name.startswith(prefix))
