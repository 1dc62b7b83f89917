"""What every bundle has: a form, options, an origin, and a manifest that describes it."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from hybrid_opt.job.compliance import (
    SKEWS,
    STIFFNESSES,
    PositionControl,
    Skew,
    largest_skew,
    position_control,
    require_delay,
    require_stiffness,
    skewed,
)
from hybrid_opt.job.records import Job, SampledJob
from hybrid_opt.job.smooth import RESTS, acceleration_at_ends
from hybrid_opt.store.files import sha256

UNITS = {
    "length": "m",
    "angle": "rad (RAPID: degrees, mm)",
    "time": "s",
    "force": "N",
    "torque": "N m",
    "stiffness": "N/m",
}

Contents = Mapping[str, str | bytes]
"""File contents by path within a bundle."""

SKEW = 0.01
"""Largest start skew expected of two controllers with clocks of their own [s]."""

LONGEST_WORD = 40

DIGEST_LENGTH = 8


@dataclass(frozen=True)
class BundleOptions:
    """How a job is written.

    Attributes:
        step: time between samples [s]; None for the form's own.
        per_arm: ROS 2: one trajectory and one controller per arm instead of one for both.
        any_arm: write a maker's own language for arms that do not look like that maker's.
        stiffness: of each arm at its pad, for what a skew and position control do [N/m].
        skew: between the starts of both arms that the job has to survive [s]; None for what the
            form leaves to chance (`Form.start_of`).
    """

    step: float | None = None
    per_arm: bool = False
    any_arm: bool = False
    stiffness: float = 1e4
    skew: float | None = None

    def __post_init__(self) -> None:
        require_stiffness(self.stiffness)
        if self.skew is not None:
            require_delay(self.skew)


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
            sha256=sha256(content),
            provenance=provenance,
        )

    def name(self, job: Job) -> str:
        """A folder's name that no other carry's bundles have."""
        words = [_word(self.study or job.workcell.name), _word(self.algorithm)]
        words += [] if self.replica is None else [f"r{self.replica:02d}"]
        words += [] if self.point is None else [f"p{self.point:04d}"]
        return "-".join(word for word in [*words, job_digest(job)[:DIGEST_LENGTH]] if word)


@dataclass(frozen=True)
class Form:
    """One form of bundles.

    Attributes:
        files: from a sampled job to file contents by path.
        step: time step where none is given [s].
        how_to_run: in words.
        start: how both arms start together, in words.
        skew: between their starts, which a job has to survive [s]; None where nobody asks.
        start_per_arm: how both start where each has a controller of its own, '' where none has.
    """

    files: Callable[[SampledJob, BundleOptions], Contents]
    step: float
    how_to_run: str
    start: str = "up to what plays the file"
    skew: float | None = None
    start_per_arm: str = ""

    def start_of(self, options: BundleOptions) -> tuple[str, float | None]:
        """How a bundle starts both arms, and the skew to survive: the one asked for, if any."""
        how, skew = self.start, self.skew
        if self.start_per_arm and options.per_arm:
            how, skew = self.start_per_arm, SKEW
        return how, skew if options.skew is None else options.skew


def manifest(
    sampled: SampledJob, name: str, form: Form, origin: Origin, options: BundleOptions
) -> dict[str, Any]:
    """JSON values: what a bundle of a form and its name holds, from which trajectory, and what it
    keeps to."""
    job, stiffness = sampled.job, options.stiffness
    how, skew = form.start_of(options)
    return {
        "form": name,
        "name": origin.name(job),
        "digest": job_digest(job),
        "workcell": {"name": job.workcell.name, "digest": job.workcell.digest},
        "trajectory": {
            "file": origin.file,
            "sha256": origin.sha256,
            "study": origin.study,
            "algorithm": origin.algorithm,
            "replica": origin.replica,
            "point": origin.point,
        },
        "timing": {"status": job.timing.status.value, "reason": job.timing.reason},
        "duration": job.duration,
        "samples": len(sampled.time),
        "robots": [
            {"name": robot.name, "joints": list(joints)}
            for robot, joints in zip(job.workcell.robots, job.joint_names, strict=True)
        ],
        "phases": phase_documents(job),
        "stands_on": [list(names) for names in job.stands_on],
        "squeeze": {
            "text": str(job.squeeze),
            "factor": job.squeeze.factor,
            "force": job.squeeze.force,
            "parts": {part.name: part.force for part in job.squeeze.parts},
            "force_controlled": job.workcell.robots[1 - job.squeeze.leader].name,
            "peak_normal_force": job.peak_normal_force.tolist(),
        },
        "position_control": [_position(position_control(job, k)) for k in STIFFNESSES],
        "start_skew": {
            "how": how,
            "required": skew,
            "survived": largest_skew(job, stiffness),
            "stiffness": stiffness,
            "cases": [_skew(skewed(job, delay, stiffness)) for delay in SKEWS],
        },
        "warnings": warnings_of(job),
        "units": UNITS,
        "how_to_run": form.how_to_run,
        "written_by": f"dual-arm-carry {_version()}",
    }


def phase_documents(job: Job) -> list[dict[str, Any]]:
    """The phases with times, forces, proof and limits, JSON values."""
    return [
        {
            "name": phase.name,
            "begin": phase.begin,
            "duration": phase.duration,
            "peak_normal_force": phase.force.normal.max(axis=0).tolist(),
            "free_of_collisions": phase.certificate.is_free,
            "most_used": phase.most_used,
            "limits": {name: float(use) for name, use in phase.use.items()},
        }
        for phase in job.phases
    ]


def warnings_of(job: Job) -> list[str]:
    """Warnings that an engineer should read before this job runs."""
    cell, found = job.workcell, []
    peak, rated = job.peak_normal_force, cell.task.reference_force
    for robot, force, most in zip(cell.robots, peak, rated, strict=True):
        if force > most:
            found.append(
                f"{robot.name} is commanded {force:.1f} N, more than its reference force of "
                f"{most:.1f} N"
            )
    jump = acceleration_at_ends(job.timing)
    if jump > RESTS:
        found.append(
            f"the carry begins or ends with {100.0 * jump:.0f} % of a joint's largest "
            "acceleration: its timing bounds no jerk, and a controller will lag behind it there"
        )
    for names, when in zip(job.stands_on, ("before", "after"), strict=True):
        if not names:
            found.append(f"nothing that the cell describes holds the box {when} the carry")
    found += [
        f"no tool_load is given for {robot.name}: torques and tool data leave out the pad's mass"
        for robot in cell.robots
        if robot.tool_load is None
    ]
    return found


def _position(found: PositionControl) -> dict[str, Any]:
    return {
        "stiffness": found.stiffness,
        "penetration": found.penetration.tolist(),
        "force_error_of_0.1_mm_each": found.force_error,
        "share_of_force": found.share,
        "margin": found.margin,
        "enough": found.verdict,
    }


def _skew(found: Skew) -> dict[str, Any]:
    return {
        "delay": found.delay,
        "displacement": found.displacement,
        "force_change": found.force_change,
        "share_of_force": found.share,
        "margin": found.margin,
        "holds": found.survived,
    }


def _version() -> str:
    try:
        return version("dual-arm-carry")
    except PackageNotFoundError:
        return "from a source folder"


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
