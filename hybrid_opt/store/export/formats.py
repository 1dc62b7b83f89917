"""The forms of bundles by name, and the one function that writes them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from hybrid_opt.job.compliance import require_skew
from hybrid_opt.job.plan import plan_job
from hybrid_opt.job.records import Job, SampledJob, sample_job
from hybrid_opt.store.export.bundle import Contents, write_bundle
from hybrid_opt.store.export.manifest import manifest
from hybrid_opt.store.export.mcap_file import mcap_files
from hybrid_opt.store.export.options import BundleOptions
from hybrid_opt.store.export.origin import Origin
from hybrid_opt.store.export.rapid import rapid_files
from hybrid_opt.store.export.ros2 import ros2_files
from hybrid_opt.store.export.start import start_of
from hybrid_opt.store.export.tables import csv_text, json_text
from hybrid_opt.store.export.urscript import urscript_files
from hybrid_opt.timing.records import Timing
from symbolic.errors import SettingsError


@dataclass(frozen=True)
class Form:
    """One form of bundles.

    Attributes:
        files: from a sampled job to file contents by path.
        step: time step where none is given [s].
    """

    files: Callable[[SampledJob, BundleOptions], Contents]
    step: float


FORMATS: Mapping[str, Form] = {
    "csv": Form(lambda sampled, options: {"job.csv": csv_text(sampled)}, 0.008),
    "json": Form(lambda sampled, options: {"job.json": json_text(sampled)}, 0.008),
    "ros2": Form(ros2_files, 0.02),
    "rapid": Form(rapid_files, 0.1),
    "urscript": Form(urscript_files, 0.008),
    "mcap": Form(mcap_files, 0.02),
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
    skew = start_of(form, options).skew
    if skew is not None:
        require_skew(whole, skew, options.stiffness)
    found = FORMATS[form]
    sampled = sample_job(whole, found.step if options.step is None else options.step)
    contents = found.files(sampled, options)
    document = manifest(sampled, form, origin, options)
    return write_bundle(Path(folder) / document["name"] / form, contents, document)
