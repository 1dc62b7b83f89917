"""The forms of bundles by name, and how one is written.

A bundle has a folder of its own and is written whole or not at all; no other file is touched.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from hybrid_opt.bundles.egm import egm_files, require_egm
from hybrid_opt.bundles.holding import stop_of
from hybrid_opt.bundles.job_file import BundleOptions, Contents, Export, csv_text, json_files
from hybrid_opt.bundles.manifest import SKEW, Origin, Target, manifest
from hybrid_opt.bundles.mcap_file import mcap_files
from hybrid_opt.bundles.rapid import rapid_files, require_rapid
from hybrid_opt.bundles.ros2 import (
    control_files,
    franka_files,
    require_franka,
    require_ur,
    ur_files,
)
from hybrid_opt.bundles.steps import chosen_step, gap_of
from hybrid_opt.bundles.urscript import require_urscript, urscript_files
from hybrid_opt.errors import ResultsError
from hybrid_opt.job.compliance import require_skew
from hybrid_opt.job.plan import plan_job
from hybrid_opt.job.records import Job, sample_job
from hybrid_opt.store.files import AGAIN, read_bytes, read_json, sha256, storing
from hybrid_opt.timing.records import Timing
from symbolic.errors import SettingsError
from symbolic.replacing import replace_file, sync_folder

MANIFEST = "manifest.json"
FORMAT = "dual-arm-carry bundle"
VERSION = 2

RUN = "run_job.py looks at both arms a hundred times a second and replaces their goals"

TARGETS: Mapping[str, Target] = {
    "ros2-control": Target(
        control_files,
        (0.02, 0.01, 0.005),
        "quintic",
        "ros2 launch launch/control.launch.py, then python3 run_job.py; mock hardware until "
        "description/cell.urdf names your simulator's",
        RUN,
        "one controller drives all joints: both arms start in the same cycle",
        0.0,
    ),
    "franka-ros2": Target(
        franka_files,
        (0.02, 0.01, 0.005),
        "quintic",
        "no end effector in Desk; ros2 launch launch/franka.launch.py, then python3 run_job.py",
        RUN,
        "the goals of both controllers bear one start time of one computer's clock",
        0.002,
        require_franka,
    ),
    "ur-ros2": Target(
        ur_files,
        (0.04, 0.02, 0.01),
        "quintic",
        "power both arms on and release their brakes; ros2 launch launch/ur.launch.py, then "
        "python3 run_job.py",
        "run_job.py slows both arms down along their paths by their speed sliders, then cancels "
        "their goals; force mode presses on",
        "both controllers get their goals at once and begin when they have them",
        SKEW,
        require_ur,
    ),
    "ur-script": Target(
        urscript_files,
        (0.008, 0.004, 0.002),
        "linear",
        "wire digital outputs 0 and 1 of each arm to inputs 0 and 1 of the other, move both arms "
        "to the first position, run one program on each; first without the box",
        "either program stretches the time of its points until it stands, servoj and force mode "
        "hold; so does the other's as soon as the heartbeat on output 1 stops",
        "both programs meet before the job over a digital line each way: what remains is a cycle "
        "and the lines' latency",
        SKEW,
        require_urscript,
    ),
    "abb-rapid": Target(
        rapid_files,
        (0.2, 0.1, 0.05, 0.02),
        "linear",
        "load T_ROB1/Carry1.mod and T_ROB2/Carry2.mod, jog both robots to carryFirst, run Carry "
        "in both tasks; first without the box, and slowly",
        "the controller stops both tasks at once; force control keeps its last reference where "
        "the controller leaves it active",
        "both tasks meet before every phase (WaitSyncTask): what remains is the difference of "
        "two planners within a phase",
        SKEW,
        require_rapid,
    ),
    "abb-egm": Target(
        egm_files,
        (0.02, 0.01, 0.005),
        "cubic",
        "load T_ROB1/CarryEgm1.mod and T_ROB2/CarryEgm2.mod, jog both robots to carryFirst, run "
        "CarryEgm in both tasks, then python3 run_egm.py; first without the box",
        "run_egm.py streams both arms from one clock and lets it stand still",
        "one clock streams the positions of both arms",
        0.004,
        require_egm,
    ),
    "mcap": Target(
        mcap_files,
        (0.02,),
        "cubic",
        "open job.mcap in Foxglove, or play it: ros2 bag play job.mcap",
    ),
    "csv": Target(
        lambda export: {"job.csv": csv_text(export)},
        (0.008,),
        "cubic",
        "one row per time step; read it with anything",
    ),
    "json": Target(json_files, (0.008,), "cubic", "job.schema.json describes job.json"),
}
"""Every target by its name."""


def export(
    job: Job | Timing,
    target: str,
    folder: str | Path,
    *,
    origin: Origin | None = None,
    options: BundleOptions | None = None,
) -> tuple[Path, ...]:
    """Write a whole job as one bundle, FOLDER/NAME/TARGET, with a manifest.

    Args:
        job: as `plan_job` makes it, or a timing that robots can drive, for the job around it with
            default forces.
        target: name of one of `TARGETS`.
        folder: what the bundle's own folder is made in.
        origin: where the carry comes from, for the name; by default the workcell's name.
        options: None for the defaults.

    Returns:
        The files written, the manifest first.

    Raises:
        SettingsError: the target is unknown, the step out of range or too long for the forces, the
            timing failed, or the target is not for these arms.
        JobError: the job cannot be done, a stop or the skew between both arms breaks its squeeze.
        ResultsError: the bundle cannot be written, or something else is in its place.
    """
    if target not in TARGETS:
        raise SettingsError(f"unknown target {target!r}; known are {', '.join(TARGETS)}")
    options, origin = options or BundleOptions(), origin or Origin()
    found = TARGETS[target]
    whole = job if isinstance(job, Job) else plan_job(job)
    found.require(whole, options)
    skew = found.skew if options.skew is None else options.skew
    if skew is not None:
        require_skew(whole, skew, options.stiffness)
    sheet = prepared(whole, found, options)
    contents = found.files(sheet)
    document = manifest(sheet, target, found, origin, skew)
    return write_bundle(Path(folder) / document["name"] / target, contents, document)


def prepared(job: Job, target: Target, options: BundleOptions) -> Export:
    """A job sampled as a target wants it: at the step asked for, or at the longest of the target's
    steps that keeps the forces.

    Raises:
        SettingsError: the step is out of range, or none keeps the forces.
        JobError: no stop along the path does.
    """
    step, stiffness = options.step, options.stiffness
    if step is None:
        step = chosen_step(job, target.steps, target.interpolation, stiffness)
    sampled = sample_job(job, step)
    gap = gap_of(sampled, target.interpolation, stiffness)
    return Export(sampled, options, gap, stop_of(job))


def write_bundle(folder: Path, contents: Contents, manifest: Mapping[str, Any]) -> tuple[Path, ...]:
    """Write a bundle, or replace an older one of the same folder, in one step.

    Everything is written beside the folder first, so that a full disk leaves what was there.

    Args:
        folder: of the bundle alone.
        contents: its files.
        manifest: JSON values; the digests of the files and of itself are added.

    Returns:
        The files written, the manifest first.

    Raises:
        ResultsError: it cannot be written, or the folder holds something else.
    """
    _require_own(folder)
    data = {
        name: text.encode() if isinstance(text, str) else text for name, text in contents.items()
    }
    document = {"format": FORMAT, "version": VERSION, **manifest}
    document["files"] = {name: sha256(content) for name, content in data.items()}
    document["sha256"] = sha256(_text(document))
    text = _text(document)
    draft = folder.with_name(f".{folder.name}.{os.getpid()}")
    old = folder.with_name(f".{folder.name}.old")
    with storing(folder, AGAIN):
        try:
            for name, content in ((MANIFEST, text), *data.items()):
                (draft / name).parent.mkdir(parents=True, exist_ok=True)
                replace_file(draft / name, content)
            if folder.exists():
                shutil.rmtree(old, ignore_errors=True)
                os.rename(folder, old)
            os.rename(draft, folder)
        except OSError:
            if old.exists() and not folder.exists():
                os.rename(old, folder)
            with suppress(OSError):
                shutil.rmtree(draft)
            raise
        shutil.rmtree(old, ignore_errors=True)
        sync_folder(folder.parent)
    return tuple(folder / name for name in (MANIFEST, *data))


def read_manifest(folder: Path) -> dict[str, Any]:
    """The manifest of a bundle.

    Raises:
        ResultsError: there is none, it is damaged, or was changed since it was written.
    """
    path = folder / MANIFEST
    document = read_json(path)
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise ResultsError(f"{path}: no manifest of a bundle")
    if document.get("version") != VERSION:
        raise ResultsError(f"{path}: version {document.get('version')!r}; known is {VERSION}")
    files = document.get("files")
    if not isinstance(files, dict) or not all(isinstance(f, str) for f in files.values()):
        raise ResultsError(f"{path}: damaged (files: expected digests by name)")
    if document.pop("sha256", None) != sha256(_text(document)):
        raise ResultsError(f"{path}: was changed since it was written, its checksum differs")
    return document


def _require_own(folder: Path) -> None:
    """Refuse to replace a folder that is not a bundle as it was written.

    Raises:
        ResultsError: with the first file that is someone else's.
    """
    if not os.path.lexists(folder):
        return
    remedy = "it stays as it is: move it away, or choose another --output"
    if folder.is_symlink() or not folder.is_dir():
        raise ResultsError(f"{folder} is in the way of a bundle; {remedy}")
    found = sorted(path for path in folder.rglob("*") if path.is_symlink() or not path.is_dir())
    if not found:
        return
    try:
        files = read_manifest(folder)["files"]
    except ResultsError as error:
        raise ResultsError(f"{found[0]} is in the way of a bundle ({error}); {remedy}") from error
    for path in found:
        name = path.relative_to(folder).as_posix()
        if name == MANIFEST:
            continue
        if name not in files or path.is_symlink():
            raise ResultsError(f"{path} is no file of this bundle; {remedy}")
        if sha256(read_bytes(path)) != files[name]:
            raise ResultsError(f"{path} was changed since it was written; {remedy}")


def _text(document: Mapping[str, Any]) -> bytes:
    return (json.dumps(document, indent=1, allow_nan=False) + "\n").encode()
