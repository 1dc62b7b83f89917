"""What every bundle has: a target, an origin, and a manifest that describes it."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from hybrid_opt.bundles.job_file import BundleOptions, Contents, Export
from hybrid_opt.bundles.steps import Interpolation
from hybrid_opt.job.compliance import (
    SKEWS,
    STIFFNESSES,
    TRACKED,
    PositionControl,
    Skew,
    largest_skew,
    position_control,
    skewed,
)
from hybrid_opt.job.records import Job
from hybrid_opt.job.smooth import RESTS, acceleration_at_ends
from hybrid_opt.store.files import sha256
from hybrid_opt.version import own_version

UNITS = {
    "length": "m",
    "angle": "rad (RAPID: degrees, mm)",
    "time": "s",
    "force": "N",
    "torque": "N m",
    "stiffness": "N/m",
}

SKEW = 0.01
"""Largest start skew expected of two controllers with clocks of their own [s]."""

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
class Target:
    """What a bundle is for.

    Attributes:
        files: from an export to file contents by path.
        steps: time steps that it can have, the longest first [s].
        interpolation: how it moves between two samples.
        how_to_run: in words.
        reaction: who carries out a stop, in words; '' for data that nobody runs.
        start: how both arms start together, in words.
        skew: between their starts, which a job has to survive [s]; None where nobody asks.
        require: refuses a job before it is sampled.
    """

    files: Callable[[Export], Contents]
    steps: tuple[float, ...]
    interpolation: Interpolation
    how_to_run: str
    reaction: str = ""
    start: str = "up to what plays the file"
    skew: float | None = None
    require: Callable[[Job, BundleOptions], None] = lambda job, options: None


STATES = {
    "ready": "both arms are looked at: news from both, pads at their first places, nothing pressed",
    "running": "both arms follow the path; phases follow one another without a gap",
    "stopping": "both arms come to rest at the same place of the path, within the stop time",
    "held": "both arms keep that place and the squeeze that belongs to it",
    "done": "the job's end, or back at its beginning",
}

STOPS = (
    "an arm is silent for longer than `silence`",
    "a pad is farther from its path than `path`",
    "an arm is later than `behind`, or both are farther apart along the path than `skew`",
    "a measured force misses its reference by more than the share `force` while pads alone hold "
    "the box",
    "a controller refuses or ends its goal",
    "someone asks for it: Ctrl-C, or the stop signal of the target",
)

SET_DOWN = (
    "from `held` the job goes on to its end ('continue'), or back along the same path to where the "
    "box stood ('back'), which takes the same forces"
)


def manifest(
    export: Export, name: str, target: Target, origin: Origin, skew: float | None
) -> dict[str, Any]:
    """JSON values: what a bundle of a target and its name holds, from which trajectory, and what it
    keeps to.

    Args:
        skew: between the starts of both arms that the job was asked to survive [s].
    """
    job, stiffness = export.job, export.options.stiffness
    return {
        "target": name,
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
        "samples": len(export.sampled.time),
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
            "force_controlled": job.workcell.robots[export.follower].name,
            "peak_normal_force": job.peak_normal_force.tolist(),
        },
        "machine": {
            "carried_out_by": target.reaction,
            "states": STATES,
            "stops_when": list(STOPS),
            "stop": asdict(export.stop),
            "limits": asdict(export.limits),
            "set_down": SET_DOWN,
        },
        "time_step": asdict(export.gap) | {"stiffness": stiffness, "allowed_share": TRACKED},
        "position_control": [_position(position_control(job, k)) for k in STIFFNESSES],
        "start_skew": {
            "how": target.start,
            "required": skew,
            "survived": largest_skew(job, stiffness),
            "stiffness": stiffness,
            "cases": [_skew(skewed(job, delay, stiffness)) for delay in SKEWS],
        },
        "warnings": warnings_of(job),
        "units": UNITS,
        "how_to_run": target.how_to_run,
        "written_by": f"dual-arm-carry {own_version()}",
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
