"""How candidates are stored: as compressed CSV once a replica is finished (docs/results.md
describes the columns), and in the append-only journal of a running one, a block per generation.

In CSV, numbers have the fewest digits that give the same bits when read back. A journal is 8 bytes
of magic, 32 bytes of identity, then blocks. A block is the length and the CRC-32 of its payload
(two little-endian 32-bit numbers) and the payload. Whatever follows the last whole block, as an
interruption leaves it, is cut off when the journal is opened again. The payload holds one
generation: the seconds it took, the number of candidates, and these one after the other.
"""

from __future__ import annotations

import gzip
import io
import os
import struct
import time
import zlib
from array import array
from collections.abc import Mapping
from dataclasses import dataclass, fields
from itertools import chain
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.campaign.folder import (
    CampaignFolder,
    configuration_of,
    executor_for,
    replica_identity,
)
from hybrid_opt.campaign.settings import JOURNAL, CampaignSettings
from hybrid_opt.errors import ResultsError
from hybrid_opt.evaluate.evaluation import FEASIBLE, REASONS, Evaluations
from hybrid_opt.progress import Advance, Progress
from hybrid_opt.store.files import csv_text, read_bytes, storing, to_json
from hybrid_opt.work.service import Ledger, Service, give_up
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


def _groups(
    n_var: int, objective_names: tuple[str, ...], reasons: tuple[str, ...] = REASONS
) -> dict[str, list[str]]:
    """Columns of numbers by the field of `Evaluations` that they hold."""
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
    """The names of all columns."""
    return [*_FIXED, *chain(*_groups(n_var, objective_names, reasons).values())]


def encode(table: EvaluationTable) -> bytes:
    """The content of the file; the same table always gives the same bytes."""
    found = table.evaluations
    words = {FEASIBLE: "", **dict(enumerate(REASONS))}
    width = found.x.shape[1]
    groups = _groups(width, table.objective_names)
    numbers = np.column_stack([getattr(found, name) for name in groups])
    lines = [",".join(columns(width, table.objective_names))]
    each = (table.generation, found.feasible, found.reason, found.position, numbers)
    for index, (generation, feasible, reason, position, row) in enumerate(
        zip(*(part.tolist() for part in each), strict=True), 1
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
            n_var = len(_between(names, "x_"))
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
    groups = _groups(n_var, objectives, stored)
    ends = np.cumsum([len(group) for group in groups.values()])[:-1]
    parts = dict(zip(groups, np.split(values[:, 4:], ends, axis=1), strict=True))
    for name in ("violation", "violation_time"):
        parts[name] = np.pad(parts[name], ((0, 0), (0, len(REASONS) - len(stored))))
    found = Evaluations(feasible=feasible == 1.0, reason=reason, position=position, **parts)
    return EvaluationTable(found, generation.astype(np.int64), objectives)


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


_MAGIC = b"DACARRY1"
_FRAME = struct.Struct("<II")
_HEAD = struct.Struct("<dI")
_SYNC_SECONDS = 1.0
"""Longest time before written blocks are forced to disk. A killed process loses
nothing that was written; only a machine that goes down does."""


def _layout(n_var: int, n_obj: int) -> np.dtype[np.void]:
    """A candidate in a block: the fields of `Evaluations` in order, little-endian, unpadded."""
    n = len(REASONS)
    return np.dtype(f"({n_var},)<f8,({n_obj},)<f8,({n_obj},)<f8,?,i1,<f8,({n},)<f8,({n},)<f8")


def encode_generation(seconds: float, generation: Evaluations) -> bytes:
    """One generation as the payload of a block."""
    rows = np.empty(len(generation), _layout(generation.x.shape[1], generation.objectives.shape[1]))
    for name, field in zip(rows.dtype.names or (), fields(Evaluations), strict=True):
        rows[name] = getattr(generation, field.name)
    return _HEAD.pack(seconds, len(generation)) + rows.tobytes()


def candidates_in(payload: bytes) -> int:
    """How many candidates a block's payload holds."""
    return int(_HEAD.unpack_from(payload)[1])


def decode_generation(payload: bytes, n_var: int, n_obj: int) -> tuple[float, Evaluations]:
    """The seconds and candidates of a block's payload.

    Raises:
        ResultsError: the size does not fit, or a value is none of a candidate's.
    """
    seconds, count = _HEAD.unpack_from(payload)
    layout = _layout(n_var, n_obj)
    if len(payload) != _HEAD.size + count * layout.itemsize:
        raise ResultsError("a journal's block does not fit the problem (its size)")
    rows = np.frombuffer(payload, layout, count, _HEAD.size)
    found = Evaluations(*(np.ascontiguousarray(rows[name]) for name in layout.names or ()))
    known = (found.reason == FEASIBLE) | ((found.reason >= 0) & (found.reason < len(REASONS)))
    if not (np.isfinite(seconds) and seconds >= 0.0 and known.all()):
        raise ResultsError("a journal's block does not fit the problem (a value is none of its)")
    return float(seconds), found


class Journal:
    """An open journal; blocks are appended, earlier ones never change.

    Attributes:
        path: the file.
        payloads: every block so far, in order.
    """

    def __init__(self, path: Path, identity: bytes) -> None:
        """Open or start a journal; a torn tail is cut off.

        Args:
            path: the file; its folder is made if it is missing.
            identity: 32 bytes that say what is recorded.

        Raises:
            ResultsError: it belongs to something else, or cannot be read or written.
        """
        self.path = path
        header = _MAGIC + identity
        content = read_bytes(path) if path.exists() else b""
        whole = len(header) if len(content) >= len(header) else 0
        if content[:whole] != header[:whole]:
            raise ResultsError(
                f"{path}: belongs to another campaign or version; delete it to compute its "
                "replica anew"
            )
        self.payloads: list[bytes] = []
        while whole and (payload := _block_at(content, whole)) is not None:
            self.payloads.append(payload)
            whole += _FRAME.size + len(payload)
        with storing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            self._handle = os.open(path, os.O_WRONLY | os.O_CREAT, 0o644)
            self._size = whole
            self._synced = time.monotonic()
            os.ftruncate(self._handle, whole)
            if whole == 0:
                self._write(header)

    def append(self, payload: bytes) -> None:
        """Add a block.

        Raises:
            ResultsError: it cannot be written; the blocks before it are kept.
        """
        with storing(self.path):
            self._write(_FRAME.pack(len(payload), zlib.crc32(payload)) + payload)
            if time.monotonic() - self._synced > _SYNC_SECONDS:
                os.fsync(self._handle)
                self._synced = time.monotonic()
        self.payloads.append(payload)

    def close(self) -> None:
        """Close the file; what was appended stays."""
        os.close(self._handle)

    def discard(self) -> None:
        """Close and delete the file, once its content is stored elsewhere."""
        self.close()
        with storing(self.path):
            self.path.unlink()

    def _write(self, content: bytes) -> None:
        view = memoryview(content)
        while view:
            written = os.pwrite(self._handle, view, self._size)
            self._size += written
            view = view[written:]


def _block_at(content: bytes, offset: int) -> bytes | None:
    """The payload of the whole block at an offset, or None."""
    if offset + _FRAME.size > len(content):
        return None
    length, checksum = _FRAME.unpack_from(content, offset)
    begin = offset + _FRAME.size
    payload = content[begin : begin + length]
    if len(payload) != length or zlib.crc32(payload) != checksum or length < _HEAD.size:
        return None
    return payload


Key = tuple[str, int]
"""Algorithm and number of a replica."""


@dataclass(frozen=True)
class ReplicaRequest:
    """A replica to search, or one whose front is to be polished.

    Attributes:
        settings: the campaign's.
        algorithm, replica: which one.
        x: (k, n_var) the workcell's hand-made trajectory alone, or the front.
        recorded: the journal's blocks of an earlier, interrupted attempt.
        paths: (m, n_path) known beside a front, see `Polisher.polish`; None for none.
    """

    settings: CampaignSettings
    algorithm: str
    replica: int
    x: Array
    recorded: tuple[bytes, ...] = ()
    paths: Array | None = None


class ReplicaLedger:
    """The replicas that are not done, and the journals of those that are being worked on: what
    ledgers (`hybrid_opt.work.service`) of the search and of the polish have alike.

    Attributes:
        folder: of the campaign.
        left: the replicas that are left, with their folders.
    """

    def __init__(
        self, folder: CampaignFolder, left: Mapping[Key, Path], **further: Mapping[str, Any]
    ) -> None:
        """Nothing is opened yet.

        Args:
            further: what decides the answers beside the campaign.
        """
        self.folder, self.left = folder, list(left.items())
        campaign = to_json(configuration_of(folder.settings, folder.root, folder.workcell))
        self._identity = {"campaign": campaign, **further}
        self._journals: dict[int, Journal] = {}

    def __len__(self) -> int:
        return len(self.left)

    def work(
        self,
        service: Service[Any, ReplicaRequest, Any],
        progress: Progress,
        stage: tuple[str, str],
        total: int,
        done: int,
    ) -> None:
        """Have all requests answered.

        Args:
            stage: title of the work, and the unit of its progress.
            total, done: how much there is in all, and was done before.
        """
        if len(self):
            # Compiles what is missing here, once, instead of in every worker.
            service.make_context()
        title, unit = stage
        with progress.stage(title, total, unit, done) as self.advance:
            ledger = cast("Ledger[ReplicaRequest, Any]", self)
            executor_for(self.folder.execution).run(service, ledger)

    advance: Advance

    def replica_request(self, index: int, x: Array, paths: Array | None = None) -> ReplicaRequest:
        """The request of a replica; see `ReplicaRequest`."""
        key, _ = self.left[index]
        recorded = tuple(self.journal(index).payloads)
        return ReplicaRequest(self.folder.settings, *key, x, recorded, paths)

    def heard(self, index: int, message: bytes) -> None:
        """See `hybrid_opt.work.service.Ledger`."""
        self.journal(index).append(message)

    def lost(self, index: int, reason: str) -> None:
        """See `hybrid_opt.work.service.Ledger`."""
        give_up(reason)

    def journal(self, index: int) -> Journal:
        """A replica's journal, opened when it is asked for first."""
        if index not in self._journals:
            key, folder = self.left[index]
            self._journals[index] = Journal(
                folder / JOURNAL, replica_identity(self._identity, *key)
            )
        return self._journals[index]

    def discard(self, index: int) -> None:
        """Close and delete a replica's journal, once its answer is stored."""
        self._journals.pop(index).discard()

    def close(self) -> None:
        """Close the journals; they stay where they are."""
        for journal in self._journals.values():
            journal.close()
