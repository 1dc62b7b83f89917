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

from hybrid_opt.bundles.manifest import SKEW, BundleOptions, Contents, Form, Origin, manifest
from hybrid_opt.bundles.mcap_file import mcap_files
from hybrid_opt.bundles.rapid import rapid_files
from hybrid_opt.bundles.ros2 import ros2_files
from hybrid_opt.bundles.tables import csv_text, json_text
from hybrid_opt.bundles.urscript import urscript_files
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
VERSION = 1

FORMATS: Mapping[str, Form] = {
    "csv": Form(
        lambda sampled, options: {"job.csv": csv_text(sampled)},
        0.008,
        "one row per time step; read it with anything",
    ),
    "json": Form(
        lambda sampled, options: {"job.json": json_text(sampled)},
        0.008,
        "read it with anything; docs/export.md lists the keys",
    ),
    "ros2": Form(
        ros2_files,
        0.02,
        "ros2 launch launch/bringup.launch.py, then python3 run_job.py; mock hardware until "
        "description/cell.urdf names your own",
        "one controller drives all joints: both arms start in the same cycle",
        0.0,
        "the goals of both controllers bear one start time: what remains is the difference of "
        "their machines' clocks",
    ),
    "rapid": Form(
        rapid_files,
        0.1,
        "load Carry1.mod in T_ROB1 and Carry2.mod in T_ROB2, connect CarryForce, jog both robots "
        "to carryFirst, run Carry in both tasks; first without the box, and slowly",
        "synchronised moves of one MultiMove controller",
        0.0,
    ),
    "urscript": Form(
        urscript_files,
        0.008,
        "wire digital output 0 of each arm to input 0 of the other, move both arms to the first "
        "position, run one program on each; first without the box",
        "both programs meet before each phase over a digital line each way: what remains is a "
        "cycle and the lines' latency",
        SKEW,
    ),
    "mcap": Form(mcap_files, 0.02, "open job.mcap in Foxglove, or play it: ros2 bag play job.mcap"),
}
"""Every form by its name."""


def export(
    job: Job | Timing,
    form: str,
    folder: str | Path,
    *,
    origin: Origin | None = None,
    options: BundleOptions | None = None,
) -> tuple[Path, ...]:
    """Write a whole job as one bundle, FOLDER/NAME/FORM, with a manifest.

    Args:
        job: as `plan_job` makes it, or a timing that robots can drive, for the job around it with
            default forces.
        form: name of one of `FORMATS`.
        folder: what the bundle's own folder is made in.
        origin: where the carry comes from, for the name; by default the workcell's name.
        options: None for the defaults.

    Returns:
        The files written, the manifest first.

    Raises:
        SettingsError: the form is unknown, the step out of range, the timing failed, or the form is
            not for these arms.
        JobError: the job cannot be done, or the skew between both arms breaks its squeeze.
        ResultsError: the bundle cannot be written, or something else is in its place.
    """
    if form not in FORMATS:
        raise SettingsError(f"unknown format {form!r}; known are {', '.join(FORMATS)}")
    options, origin = options or BundleOptions(), origin or Origin()
    whole = job if isinstance(job, Job) else plan_job(job)
    _, skew = FORMATS[form].start_of(options)
    if skew is not None:
        require_skew(whole, skew, options.stiffness)
    found = FORMATS[form]
    sampled = sample_job(whole, found.step if options.step is None else options.step)
    contents = found.files(sampled, options)
    document = manifest(sampled, form, found, origin, options)
    return write_bundle(Path(folder) / document["name"] / form, contents, document)


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
