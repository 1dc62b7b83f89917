"""Origin of a carry, and the name that its bundles get from it."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hybrid_opt.job.records import Job

LONGEST_WORD = 40
DIGEST_LENGTH = 8


@dataclass(frozen=True)
class Origin:
    """Origin of a carry.

    Attributes:
        study: name of the study or, without one, of the workcell.
        algorithm: name of the search, with '-polished' where its front was polished.
        replica: number of the replica; None where there is none.
        point: row of the candidate among the evaluations, or another number of the point.
        file: the trajectory file, '' where there is none.
        sha256: of that file.
        provenance: as stored in it.
    """

    study: str = ""
    algorithm: str = ""
    replica: int | None = None
    point: int | None = None
    file: str = ""
    sha256: str = ""
    provenance: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def of_file(cls, path: Path, content: bytes, provenance: Mapping[str, Any]) -> Origin:
        """The origin of a trajectory file, as its place in a results folder and it itself tell.

        Args:
            path: RESULTS/selected/ALGORITHM/REPLICA.json, or any other.
            content: of the file.
            provenance: as stored in it.
        """
        path = path.resolve()
        selected = len(path.parts) > 4 and path.parts[-3] == "selected"
        algorithm = path.parts[-2] if selected else provenance.get("algorithm")
        return cls(
            study=path.parts[-4] if selected else path.stem,
            algorithm=algorithm if isinstance(algorithm, str) else "",
            replica=_number(provenance.get("replica")),
            point=_number(provenance.get("row")),
            file=path.name,
            sha256=hashlib.sha256(content).hexdigest(),
            provenance=provenance,
        )

    def name(self, job: Job) -> str:
        """A folder's name that no other carry's bundles have."""
        words = [_word(self.study or job.workcell.name), _word(self.algorithm)]
        words += [] if self.replica is None else [f"r{self.replica:02d}"]
        words += [] if self.point is None else [f"p{self.point:04d}"]
        return "-".join(word for word in [*words, job_digest(job)[:DIGEST_LENGTH]] if word)


def job_digest(job: Job) -> str:
    """SHA-256 of what decides a job: cell, path, timing, forces."""
    digest = hashlib.sha256(job.workcell.digest.encode())
    carry = job.timing.carry
    assert carry is not None, "a job is planned around a carry"
    for values in (carry.x, carry.time, *(phase.force.normal for phase in job.phases)):
        digest.update(values.tobytes())
    return digest.hexdigest()


def _number(value: Any) -> int | None:
    is_number = isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 10**9
    return value if is_number else None


def _word(text: str) -> str:
    """Text as part of a file's name on every system."""
    kept = "".join(c if c.isascii() and c.isalnum() else "-" for c in text.lower())
    return "-".join(part for part in kept.split("-") if part)[:LONGEST_WORD].strip("-")
