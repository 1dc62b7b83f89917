"""Evaluated candidates of a search as one compressed CSV file; docs/reference/results.md lists its
columns.

The first line is a comment with the duration of the search. Numbers have the fewest digits that
give the same bits when read back.
"""

from __future__ import annotations

import gzip
import io
import math
import zlib
from array import array
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.errors import ResultsError
from hybrid_opt.evaluate.evaluation import FEASIBLE, REASONS, Evaluations
from symbolic.array import Array

_LEVEL = 4
_SECONDS = "# seconds: "
_FIXED = ("evaluation", "feasible", "reason", "position")
_REASON = _FIXED.index("reason")
_LONGEST_LINE = 1_000_000

_ROOM = 2**24
_BYTES_PER_NUMBER = 2
"""A file may contain `_ROOM` numbers, and one more per so many of its bytes. Zeros can be packed
tighter, but evaluated candidates have more digits than zeros."""


@dataclass(frozen=True)
class EvaluatedCandidates:
    """Content of a file of evaluated candidates.

    Attributes:
        evaluations: every candidate in the order of evaluation.
        objective_names: names of the objectives, in the order of their columns.
        seconds: duration of the search [s].
    """

    evaluations: Evaluations
    objective_names: tuple[str, ...]
    seconds: float


def _groups(
    n_var: int, objective_names: tuple[str, ...], reasons: tuple[str, ...] = REASONS
) -> dict[str, list[str]]:
    """Return the names of the columns of a file of candidates that hold numbers, by field of
    `Evaluations`.

    Args:
        n_var: length of the decision vector.
        objective_names: names of the objectives.
        reasons: names of the constraints.
    """
    return {
        "x": [f"x_{k + 1}" for k in range(n_var)],
        "objectives": [f"objective_{name}" for name in objective_names],
        "penalised": [f"penalised_{name}" for name in objective_names],
        "violation": [f"violation_{reason}" for reason in reasons],
        "violation_time": [f"violation_time_{reason}" for reason in reasons],
    }


def columns(
    n_var: int, objective_names: tuple[str, ...], reasons: tuple[str, ...] = REASONS
) -> list[str]:
    """Return the names of all columns of a file of candidates, in order.

    Args:
        n_var: length of the decision vector.
        objective_names: names of the objectives.
        reasons: names of the constraints.
    """
    return [*_FIXED, *chain(*_groups(n_var, objective_names, reasons).values())]


def encode(candidates: EvaluatedCandidates) -> bytes:
    """Return candidates as the content of a file. Equal candidates always give equal bytes."""
    found = candidates.evaluations
    words = {FEASIBLE: "", **dict(enumerate(REASONS))}
    width = found.x.shape[1]
    groups = _groups(width, candidates.objective_names)
    numbers = np.column_stack([getattr(found, name) for name in groups])
    names = columns(width, candidates.objective_names)
    lines = [f"{_SECONDS}{candidates.seconds!r}", ",".join(names)]
    each = (found.feasible, found.reason, found.position, numbers)
    for index, (feasible, reason, position, row) in enumerate(
        zip(*(part.tolist() for part in each), strict=True), 1
    ):
        head = f"{index},{int(feasible)},{words[reason]},{position!r},"
        lines.append(head + ",".join(map(repr, row)))
    return gzip.compress(("\n".join(lines) + "\n").encode(), _LEVEL, mtime=0)


def decode(content: bytes, path: Path) -> EvaluatedCandidates:
    """Read the candidates in a file's content.

    Args:
        content: content of the file, from `encode`.
        path: path of the file, for messages.

    Raises:
        ResultsError: the content is damaged.
    """
    try:
        with gzip.open(io.BytesIO(content)) as file:
            seconds = _seconds(_text(file.readline(_LONGEST_LINE)))
            names = _text(file.readline(_LONGEST_LINE)).split(",")
            objectives = _between(names, "objective_")
            n_var = len(_between(names, "x_"))
            # Reasons are only ever added, at the end: older files have the first of them.
            stored = REASONS[: len(_between(names, "violation_time_"))]
            if names != columns(n_var, objectives, stored):
                raise ValueError("its columns are not those of this version")
            most = _ROOM + len(content) // _BYTES_PER_NUMBER
            values, reason = _rows(file, len(names), most)
        _, feasible, position = values[:, :3].T
        _check(values, feasible, values[:, 3 : 3 + n_var])
    except (OSError, EOFError, zlib.error, ValueError, KeyError, IndexError) as error:
        raise ResultsError(
            f"{path}: damaged ({error}); --resume computes it anew", code="damaged"
        ) from error
    groups = _groups(n_var, objectives, stored)
    ends = np.cumsum([len(group) for group in groups.values()])[:-1]
    parts = dict(zip(groups, np.split(values[:, 3:], ends, axis=1), strict=True))
    for name in ("violation", "violation_time"):
        parts[name] = np.pad(parts[name], ((0, 0), (0, len(REASONS) - len(stored))))
    found = Evaluations(feasible=feasible == 1.0, reason=reason, position=position, **parts)
    return EvaluatedCandidates(found, objectives, seconds)


def _seconds(line: str) -> float:
    seconds = float(line.removeprefix(_SECONDS))
    if not (line.startswith(_SECONDS) and math.isfinite(seconds) and seconds >= 0.0):
        raise ValueError("its first line does not say how long the search took")
    return seconds


def _text(line: bytes) -> str:
    if len(line) == _LONGEST_LINE:
        raise ValueError(f"a line of more than {_LONGEST_LINE} characters")
    return line.decode("ascii").rstrip("\n")


def _rows(file: gzip.GzipFile, width: int, most: int) -> tuple[Array, NDArray[np.int8]]:
    """Read all rows of a file of candidates.

    Rows are read one by one, so a small compressed file cannot expand to a huge amount of memory.

    Args:
        file: the file, after its header.
        width: number of columns.
        most: allowed number of numbers in the file; a larger one raises a ValueError.

    Returns:
        - Numbers (n, width - 1) of the n candidates.
        - Index (n,) of the constraint that each candidate violates first.
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


def _check(values: Array, feasible: Array, x: Array) -> None:
    if not len(values):
        raise ValueError("it holds no candidates")
    if not np.isfinite(x).all():
        raise ValueError("a decision vector is not finite")
    if not np.isin(feasible, (0.0, 1.0)).all():
        raise ValueError("the column feasible holds other than 0 and 1")


def _between(names: list[str], prefix: str) -> tuple[str, ...]:
    return tuple(name.removeprefix(prefix) for name in names if name.startswith(prefix))
