"""Evaluated candidates as compressed CSV. docs/results.md describes the columns.

Numbers are written with the fewest digits that give the same bits when read back.
"""

from __future__ import annotations

import gzip
import io
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.errors import ResultsError
from hybrid_opt.evaluate.evaluation import FEASIBLE, REASONS, Evaluations

_LEVEL = 4
_FIXED = ("evaluation", "generation", "feasible", "reason", "position")


@dataclass(frozen=True)
class EvaluationTable:
    """What a file of evaluated candidates holds.

    Attributes:
        evaluations: every candidate in the order of evaluation.
        generation: (n,) number of the generation of each, from 1.
        objective_names: of the columns of the objectives.
    """

    evaluations: Evaluations
    generation: NDArray[np.int64]
    objective_names: tuple[str, ...]


def columns(n_var: int, objective_names: tuple[str, ...]) -> list[str]:
    """The names of all columns."""
    return [
        *_FIXED,
        *(f"x_{k + 1}" for k in range(n_var)),
        *(f"objective_{name}" for name in objective_names),
        *(f"penalised_{name}" for name in objective_names),
        *(f"violation_{reason}" for reason in REASONS),
        *(f"violation_time_{reason}" for reason in REASONS),
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
        text = gzip.decompress(content).decode("ascii")
        header, _, body = text.partition("\n")
        names = header.split(",")
        objectives = _between(names, "objective_")
        n_var, n_obj = len(_between(names, "x_")), len(objectives)
        if names != columns(n_var, objectives):
            raise ValueError("its columns are not those of this version")
        reasons = {"": FEASIBLE, **{reason: k for k, reason in enumerate(REASONS)}}
        rows = body.splitlines()
        reason = np.array([reasons[row.split(",", 4)[3]] for row in rows], dtype=np.int8)
        numeric = [k for k, name in enumerate(names) if name != "reason"]
        values = np.loadtxt(io.StringIO(body), delimiter=",", usecols=numeric, ndmin=2)
    except (OSError, EOFError, zlib.error, ValueError, KeyError, IndexError) as error:
        raise ResultsError(f"{path}: damaged ({error})") from error
    order, generation, feasible, position = values[:, :4].T
    if not np.array_equal(order, np.arange(1, len(values) + 1)):
        raise ResultsError(f"{path}: damaged (candidates are missing or out of order)")
    widths = np.cumsum([n_var, n_obj, n_obj, len(REASONS), len(REASONS)])
    x, plain, penalised, violation, violation_time, _ = np.split(values[:, 4:], widths, axis=1)
    return EvaluationTable(
        Evaluations(
            x, plain, penalised, feasible == 1.0, reason, position, violation, violation_time
        ),
        generation.astype(np.int64),
        objectives,
    )


def encode_front(table: EvaluationTable, rows: NDArray[np.intp]) -> bytes:
    """Some candidates as plain CSV: evaluation, objectives and decision vector."""
    found = table.evaluations
    names = [*table.objective_names, *(f"x_{k + 1}" for k in range(found.x.shape[1]))]
    lines = [",".join(["evaluation", *names])]
    for row in rows.tolist():
        numbers = [*found.objectives[row].tolist(), *found.x[row].tolist()]
        lines.append(f"{row + 1}," + ",".join(map(repr, numbers)))
    return ("\n".join(lines) + "\n").encode()


def _between(names: list[str], prefix: str) -> tuple[str, ...]:
    return tuple(name.removeprefix(prefix) for name in names if name.startswith(prefix))
