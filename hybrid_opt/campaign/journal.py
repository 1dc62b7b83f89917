"""The append-only journal of a running replica: one block per generation.

A file is 8 bytes of magic, 32 bytes of identity, then blocks. A block is the length and the
CRC-32 of its payload (two little-endian 32-bit numbers) and the payload. Whatever follows the
last whole block, as an interruption leaves it, is cut off when the journal is opened again. The
payload holds one generation: the seconds it took, the number of candidates, and the arrays of
`Evaluations` in order, little-endian.
"""

from __future__ import annotations

import os
import struct
import time
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, cast

import numpy as np

from hybrid_opt.campaign.folder import CampaignFolder, executor_for, identity, replica_identity
from hybrid_opt.campaign.settings import JOURNAL, CampaignSettings
from hybrid_opt.campaign.stages import Advance, Progress
from hybrid_opt.errors import ResultsError
from hybrid_opt.evaluate.evaluations import FEASIBLE, REASONS, Evaluations
from hybrid_opt.store.files import read_bytes, storing
from hybrid_opt.work.service import Ledger, Service, give_up
from symbolic.array import Array

_MAGIC = b"DACARRY1"
_FRAME = struct.Struct("<II")
_HEAD = struct.Struct("<dI")
_SYNC_SECONDS = 1.0
"""At most so long may pass before written blocks are forced to disk. A killed process loses
nothing that was written; only a machine that goes down does."""


def encode_generation(seconds: float, generation: Evaluations) -> bytes:
    """One generation as the payload of a block."""
    arrays = (getattr(generation, field.name) for field in fields(Evaluations))
    parts = [array.astype(array.dtype.newbyteorder("<"), copy=False).tobytes() for array in arrays]
    return _HEAD.pack(seconds, len(generation)) + b"".join(parts)


def candidates_in(payload: bytes) -> int:
    """How many candidates a block's payload holds."""
    return int(_HEAD.unpack_from(payload)[1])


def decode_generation(payload: bytes, n_var: int, n_obj: int) -> tuple[float, Evaluations]:
    """The seconds and candidates of a block's payload.

    Raises:
        ResultsError: the size does not fit.
    """
    kinds: dict[str, tuple[str, tuple[int, ...]]] = {
        "x": ("<f8", (n_var,)),
        "objectives": ("<f8", (n_obj,)),
        "penalised": ("<f8", (n_obj,)),
        "feasible": ("?", ()),
        "reason": ("<i1", ()),
        "position": ("<f8", ()),
        "violation": ("<f8", (len(REASONS),)),
        "violation_time": ("<f8", (len(REASONS),)),
    }
    seconds, count = _HEAD.unpack_from(payload)
    offset, arrays = _HEAD.size, {}
    try:
        for field in fields(Evaluations):
            kind, shape = kinds[field.name]
            size = int(np.prod(shape, dtype=int)) * count
            array = np.frombuffer(payload, kind, size, offset).reshape(count, *shape)
            offset += array.nbytes
            arrays[field.name] = array.astype(array.dtype.newbyteorder("="))
    except ValueError as error:
        raise ResultsError(f"a journal's block does not fit the problem ({error})") from error
    if offset != len(payload):
        raise ResultsError("a journal's block does not fit the problem (it is too long)")
    reasons = arrays["reason"]
    known = (reasons == FEASIBLE) | ((reasons >= 0) & (reasons < len(REASONS)))
    if not (np.isfinite(seconds) and seconds >= 0.0 and known.all()):
        raise ResultsError("a journal's block does not fit the problem (a value is none of its)")
    return float(seconds), Evaluations(**arrays)


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
        campaign = identity(folder.settings, folder.root, folder.workcell)
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
            stage: title of what is being done, and what is counted.
            total, done: so much in all, and before.
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
