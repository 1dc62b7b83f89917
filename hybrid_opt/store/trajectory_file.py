"""A trajectory stored as one self-contained JSON file. docs/export.md describes the format.

The file holds the decision vector, the start postures, the figures it was reported with, how it
came about, and the whole workcell with every file that the workcell names. Reading it executes
nothing and trusts nothing: every field is checked.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hybrid_opt.errors import ResultsError
from hybrid_opt.evaluate.functions import workcell_functions
from symbolic.array import Array
from symbolic.errors import BundleError
from symbolic.workcell.archive import (
    CellArchive,
    archive_cell,
    archive_from_json,
    archive_to_json,
    unpack_cell,
)
from symbolic.workcell.records import Workcell

FORMAT = "dual-arm-carry trajectory"
VERSION = 1
MAX_FILE_BYTES = 512 * 2**20
_KEYS = {"format", "version", "decision", "start", "figures", "provenance", "cell"}


@dataclass(frozen=True)
class StoredTrajectory:
    """What a trajectory file holds.

    Attributes:
        x: (n_var,) decision vector.
        start: (2, 6) joint positions of both arms at the first sample [rad].
        figures: the figures it was stored with, SI units.
        provenance: how it came about (algorithm, seed, versions, ...), JSON values.
        cell: the workcell's files.
    """

    x: Array
    start: Array
    figures: Mapping[str, float]
    provenance: Mapping[str, Any]
    cell: CellArchive

    def unpack(self, folder: Path) -> Workcell:
        """Write the workcell's files below a folder and read it.

        Raises:
            ResultsError: the stored workcell is not valid, or does not fit the decision vector.
        """
        workcell = unpack_cell(self.cell, folder)
        if self.x.shape != (workcell.task.n_var,):
            raise ResultsError(
                f"decision: {len(self.x)} values; the stored workcell has {workcell.task.n_var}"
            )
        return workcell


def write_trajectory(
    path: str | Path,
    workcell: Workcell,
    x: Array,
    figures: Mapping[str, float],
    provenance: Mapping[str, Any],
) -> None:
    """Store a trajectory with its workcell; an existing file is replaced in one step.

    Args:
        path: the file to write; its folder has to exist.
        workcell: as read from its file.
        x: (n_var,) decision vector.
        figures: finite numbers by name, as from `hybrid_opt.store.trajectory_figures`.
        provenance: JSON values: algorithm, seed, versions and whatever else explains it.

    Raises:
        ResultsError: the workcell was changed after reading, or a value cannot be stored.
    """
    x = np.asarray(x, dtype=float)
    if x.shape != (workcell.task.n_var,) or not np.isfinite(x).all():
        raise ResultsError(f"decision vector: expected {workcell.task.n_var} finite numbers")
    outputs = workcell_functions(workcell)["candidate"](x)
    document = {
        "format": FORMAT,
        "version": VERSION,
        "decision": x.tolist(),
        "start": [outputs["q_1"][0].tolist(), outputs["q_2"][0].tolist()],
        "figures": {name: _figure(name, value) for name, value in figures.items()},
        "provenance": dict(provenance),
        "cell": archive_to_json(archive_cell(workcell)),
    }
    try:
        text = json.dumps(document, indent=1, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ResultsError(f"the trajectory cannot be stored as JSON: {error}") from error
    _write(Path(path), text)


def read_trajectory(path: str | Path) -> StoredTrajectory:
    """Read and check a trajectory file.

    Raises:
        ResultsError: the file cannot be read, or a field is wrong.
    """
    path = Path(path)
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise ResultsError(f"{path}: larger than {MAX_FILE_BYTES // 2**20} MiB")
        data = json.loads(path.read_bytes(), parse_constant=_refuse_constant)
    except OSError as error:
        raise ResultsError(f"{path}: cannot be read ({error.strerror})") from error
    except (ValueError, RecursionError) as error:
        raise ResultsError(f"{path}: not a trajectory file: {error}") from error
    try:
        return _checked(data)
    except (ResultsError, BundleError) as error:
        raise ResultsError(f"{path}: {error}") from error


def _checked(data: Any) -> StoredTrajectory:
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise ResultsError(f"not a trajectory file: `format` is not {FORMAT!r}")
    if data.get("version") != VERSION:
        raise ResultsError(f"version {data.get('version')!r}; this program reads {VERSION}")
    if set(data) != _KEYS:
        odd = ", ".join(sorted(set(data) ^ _KEYS))
        raise ResultsError(f"keys missing or unknown: {odd}")
    start = data["start"]
    if not isinstance(start, list) or len(start) != 2:
        raise ResultsError("start: expected two arrays")
    if not isinstance(data["figures"], dict) or not isinstance(data["provenance"], dict):
        raise ResultsError("figures and provenance: expected objects")
    return StoredTrajectory(
        x=_vector(data["decision"], "decision"),
        start=np.array([_vector(row, "start", 6) for row in start]),
        figures={name: _figure(name, value) for name, value in data["figures"].items()},
        provenance=data["provenance"],
        cell=archive_from_json(data["cell"]),
    )


def _vector(value: Any, name: str, length: int | None = None) -> Array:
    if not isinstance(value, Sequence) or (length is not None and len(value) != length):
        raise ResultsError(f"{name}: expected {length or 'an array of'} numbers")
    return np.array([_figure(f"{name}[{k}]", entry) for k, entry in enumerate(value)])


def _figure(name: str, value: Any) -> float:
    is_number = isinstance(value, int | float | np.integer | np.floating)
    if not isinstance(value, bool) and is_number:
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
        if math.isfinite(number):
            return number
    raise ResultsError(f"{name}: found {str(value)[:60]}; expected a finite number")


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is not allowed")


def _write(path: Path, text: str) -> None:
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with draft.open("w", encoding="utf-8") as file:
            file.write(text + "\n")
            file.flush()
            os.fsync(file.fileno())
        os.replace(draft, path)
    except OSError as error:
        draft.unlink(missing_ok=True)
        raise ResultsError(f"{path}: cannot be written ({error.strerror})") from error
