"""A bundle: the manifest that describes it, its README, and how it is written.

A bundle has its own folder, which is written completely or not at all. No other file is touched.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from hybrid_opt.extras.bundles.arms import addressed
from hybrid_opt.extras.bundles.job_file import (
    BundleOptions,
    Contents,
    Export,
    chosen_step,
    gap_of,
    timing_model,
)
from hybrid_opt.extras.bundles.stopping import stop_of
from hybrid_opt.extras.bundles.targets import Target, missing_loads, target_for
from hybrid_opt.job.compliance import (
    SKEWS,
    STIFFNESSES,
    TRACKED,
    PositionControl,
    Skew,
    largest_skew,
    position_control,
    require_skew,
    skewed,
)
from hybrid_opt.job.plan import plan_job
from hybrid_opt.job.records import Job, sample_job
from hybrid_opt.store.bundle_file import MANIFEST, write_bundle
from hybrid_opt.store.files import own_version, sha256
from hybrid_opt.timing.jerk import RESTS, acceleration_at_ends
from hybrid_opt.timing.records import Timing
from symbolic.contact.registry import contact_model
from symbolic.errors import SettingsError

UNITS = {
    "length": "m",
    "angle": "rad (RAPID: degrees, mm)",
    "time": "s",
    "force": "N",
    "torque": "N m",
    "stiffness": "N/m",
}

LONGEST_WORD = 40

DIGEST_LENGTH = 8


@dataclass(frozen=True)
class Origin:
    """Source of a carry: a study and one point of its front.

    Attributes:
        study: name of the study or, without one, of the workcell.
        algorithm: name of the search, with '-polished' if the front was polished.
        replica: number of the replica of the search; None if there is none.
        point: index of the candidate in the order of evaluation, or the number of the point on its
            front; None if there is none.
        file: path of the trajectory file, '' if there is none.
        sha256: SHA-256 of the trajectory file.
        provenance: provenance stored in the trajectory file.
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
        """Derive the origin of a carry from its trajectory file.

        If the path is RESULTS/selected/ALGORITHM/REPLICA.json, the names of study and algorithm
        follow from it. Otherwise the study is named after the file, and the algorithm follows from
        the provenance.

        Args:
            path: path of the file.
            content: content of the file, of which the SHA-256 is stored.
            provenance: provenance in the file.
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
        """Return a folder name that is unique to the carry of a job."""
        words = [_word(self.study or job.workcell.name), _word(self.algorithm)]
        words += [] if self.replica is None else [f"r{self.replica:02d}"]
        words += [] if self.point is None else [f"p{self.point:04d}"]
        return "-".join(word for word in [*words, job_digest(job)[:DIGEST_LENGTH]] if word)


STATES = {
    "ready": "both arms are checked: they report, pads are where they begin, nothing presses",
    "running": "both arms follow the path; phases follow each other without a gap",
    "stopping": "both arms come to rest at the same place of the path, within the stop time",
    "landing": "the box stands before the end of its set-down: both arms let go of it there",
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
    "a request: Ctrl-C, or the stop signal of the target",
)

SET_DOWN = (
    "from `held` the job goes on to its end ('continue'), or back along the same path to where the "
    "box stood ('back'), which takes the same forces"
)


def manifest(
    export: Export, name: str, target: Target, origin: Origin, skew: float | None
) -> dict[str, Any]:
    """Return the manifest of a target's bundle as JSON values: content, origin of the trajectory,
    and limits.

    Args:
        export: the job with the data of its files.
        name: name of the target.
        target: the target.
        origin: origin of the carry.
        skew: delay between the starts of both arms that the job has to tolerate [s]; None if this
            is not checked.
    """
    job, k = export.job, export.stiffness
    is_lost = bool(target.reaction and export.partner_stop.warning)
    step: dict[str, Any] = {"step": export.step}
    if export.gap is not None:
        step = asdict(export.gap) | {"stiffness": k, "allowed_share": TRACKED}
    skews: dict[str, Any] = {"how": target.start, "required": skew, "stiffness": k}
    if k is not None:
        skews |= {"survived": largest_skew(job, k)}
        skews |= {"cases": [_skew(skewed(job, delay, k)) for delay in SKEWS]}
    return {
        "target": name,
        "name": origin.name(job),
        "digest": job_digest(job),
        "workcell": {"name": job.workcell.name, "digest": job.workcell.digest},
        "trajectory": {k: v for k, v in vars(origin).items() if k != "provenance"},
        "timing": {"status": job.timing.status.value, "reason": job.timing.reason},
        "duration": job.duration,
        "samples": len(export.sampled.time),
        "robots": [
            {"name": robot.name, "joints": list(joints)}
            for robot, joints in zip(job.workcell.robots, job.joint_names, strict=True)
        ],
        "phases": [
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
        ],
        "stands_on": [list(names) for names in job.stands_on],
        "squeeze": {
            "text": str(job.squeeze),
            "order": job.squeeze.order,
            "factor": job.squeeze.factor,
            "force": job.squeeze.force,
            "assumes": f"the planned wrenches are of {contact_model(job.workcell).assumption}",
            "parts": {part.name: part.force for part in job.squeeze.parts},
            "control": job.control,
            "peak_normal_force": job.peak_normal_force.tolist(),
        },
        "machine": {
            "carried_out_by": target.reaction,
            "states": STATES,
            "stops_when": list(STOPS),
            "stop": asdict(export.stop),
            "partner_stop": asdict(export.partner_stop) | {"text": str(export.partner_stop)},
            "limits": asdict(export.limits),
            "set_down": SET_DOWN,
        },
        "time_step": step,
        "position_control": [
            _position(position_control(job, k)) for k in STIFFNESSES if job.follower is not None
        ],
        "start_skew": skews,
        "warnings": warnings_of(job) + ([export.partner_stop.warning] if is_lost else []),
        "units": UNITS,
        "how_to_run": target.how_to_run,
        "written_by": f"dual-arm-carry {own_version()}",
    }


def readme(document: Mapping[str, Any], contents: Contents) -> str:
    """Return the README of a bundle: its content, how to run it, and what stops the robots.

    Args:
        document: the manifest, from `manifest`.
        contents: the other files of the bundle by path, which are listed.
    """
    squeeze, machine = document["squeeze"], document["machine"]
    phases = [
        f"| {phase['name'].replace('_', ' ')} | {phase['begin']:.2f} | {phase['duration']:.2f} | "
        f"{max(phase['peak_normal_force']):.1f} |"
        for phase in document["phases"]
    ]
    runs = [] if not machine["carried_out_by"] else ["", "## What stops it", ""]
    if runs:
        runs += [f"{machine['carried_out_by']}. It stops both arms when", ""]
        runs += [f"- {reason}" for reason in machine["stops_when"]]
        runs += ["", f"{machine['partner_stop']['text']}."]
    warned = [f"- {warning}" for warning in document["warnings"]]
    return "\n".join(
        [
            f"# {document['name']} for {document['target']}",
            "",
            f"The whole job of *{document['workcell']['name']}*: {document['duration']:.2f} s. "
            f"{squeeze['order'].capitalize()} at most {squeeze['force']:.1f} N; "
            f"{squeeze['control']}. {squeeze['text'][0].upper()}{squeeze['text'][1:]}.",
            "",
            "## How to run it",
            "",
            f"{document['how_to_run'][0].upper()}{document['how_to_run'][1:]}.",
            *runs,
            *(["", "## Read before it runs", "", *warned] if warned else []),
            "",
            "## Phases",
            "",
            "| phase | begins [s] | takes [s] | force [N] |",
            "|---|---|---|---|",
            *phases,
            "",
            "## Files",
            "",
            f"- `{MANIFEST}`: all of this for programs, with limits, origin and a digest of every "
            "file",
            *(f"- `{name}`" for name in contents),
            "",
            f"Written by {document['written_by']}.",
            "",
        ]
    )


def warnings_of(job: Job) -> list[str]:
    """Return sentences that an engineer should read before a job runs; empty for none."""
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
    if job.follower is None:
        found += [
            f"{robot.name} has no grip_input: nobody looks whether its hands hold before the box "
            "is lifted and while it is carried"
            for robot in cell.robots
            if not robot.driver.grip_input
        ]
    return [*found, *missing_loads(cell)]


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
        "holds": found.is_held,
    }


def job_digest(job: Job) -> str:
    """Compute a SHA-256 over everything that determines a job: cell, path, timing and forces."""
    digest = hashlib.sha256(job.workcell.digest.encode())
    carry = job.timing.driven
    for values in (carry.x, carry.time, *(phase.force.normal for phase in job.phases)):
        digest.update(values.tobytes())
    return digest.hexdigest()


def _number(value: Any) -> int | None:
    is_number = isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 10**9
    return value if is_number else None


def _word(text: str) -> str:
    """Convert a text to a part of a file name that is valid on every system: lower-case ASCII
    letters, digits and single hyphens."""
    kept = "".join(c if c.isascii() and c.isalnum() else "-" for c in text.lower())
    return "-".join(part for part in kept.split("-") if part)[:LONGEST_WORD].strip("-")


README = "README.md"


def export(
    job: Job | Timing,
    target: str,
    folder: str | Path,
    *,
    origin: Origin | None = None,
    options: BundleOptions | None = None,
) -> tuple[Path, ...]:
    """Write a whole job as a bundle to FOLDER/NAME/TARGET, with a manifest.

    Args:
        job: a job from `plan_job`; or a drivable timing, for which a job with default forces is
            planned.
        target: name of a target in `TARGETS`.
        folder: parent folder of the bundle.
        origin: origin of the carry, for the name of the bundle; None for the workcell's name.
        options: options of the bundle; None for the defaults.

    Returns:
        The files written, the manifest first.

    Raises:
        SettingsError: the target is unknown or not for these arms; the time step is out of range,
            or so long that normal forces between samples differ too much from the commanded ones;
            or the timing failed.
        JobError: the job cannot be planned; or friction would not hold the box during a stop, or if
            one arm starts later than the other by the skew.
        ResultsError: the bundle cannot be written, or its folder contains something else.
    """
    options, origin = options or BundleOptions(), origin or Origin()
    whole = job if isinstance(job, Job) else plan_job(job)
    if options.addresses is not None:
        whole = replace(whole, workcell=addressed(whole.workcell, options.addresses))
    found = target_for(target, whole.workcell)
    found.refuse(whole, target, options.any_arm)
    skew = found.skew if options.skew is None else options.skew
    sheet = prepared(whole, target, options)
    if skew is not None:
        if sheet.stiffness is None:
            raise SettingsError(
                "what a skew does depends on the stiffness of the arms: --stiffness",
                code="no-stiffness",
            )
        require_skew(whole, skew, sheet.stiffness)
    document = manifest(sheet, target, found, origin, skew)
    contents = found.files(sheet)
    contents = {README: readme(document, contents), **contents}
    return write_bundle(Path(folder) / document["name"] / target, contents, document)


def prepared(job: Job, name: str, options: BundleOptions) -> Export:
    """Sample a job for a bundle at even time steps, and find its shortest stop.

    The step is the requested one. Without a request it is the target's longest step with which the
    normal forces between samples stay close to the commanded ones.

    Args:
        job: the job.
        name: name of the target.
        options: options of the bundle, with the requested step and stiffness.

    Raises:
        SettingsError: the step is out of range, no step keeps the force error small enough, or the
            target needs a stiffness that is unknown.
        JobError: stops of every tried duration need more than the commanded forces somewhere on the
            path.
    """
    target, step, k = target_for(name, job.workcell), options.step, options.stiffness
    k = target.stiffness_of(job, name) if k is None else k
    if step is None:
        step = target.steps[0]
        if k is not None:
            step = chosen_step(job, target.steps, target.interpolation, k)
    sampled = sample_job(job, step)
    gap = None if k is None else gap_of(sampled, target.interpolation, k)
    return Export(sampled, k, gap, stop_of(job, timing_model(job.workcell)))
