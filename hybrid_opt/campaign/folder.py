"""Execution of a campaign, and its results folder. One process locks the folder. It belongs to one
workcell, one set of settings and one version of the software."""

from __future__ import annotations

import json
import os
import platform
import shutil
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal

from codegen.cache import source_digest
from hybrid_opt.campaign.settings import (
    CONFIGURATION,
    STAGES,
    WORKCELL,
    CampaignSettings,
    Configuration,
    StoredCell,
)
from hybrid_opt.cell import Cell
from hybrid_opt.cluster import DaskWorkers
from hybrid_opt.errors import ResultsError
from hybrid_opt.store.files import (
    LOCK,
    locked,
    own_version,
    read_json,
    storing,
    to_json,
    write_json,
)
from hybrid_opt.workers import LocalWorkers, Workers
from symbolic.array import Range, require_allowed
from symbolic.errors import SettingsError
from symbolic.read.cell import load
from symbolic.read.cell_files import CellFiles, collect_cell, unpack_cell
from symbolic.records import Workcell
from symbolic.safe_io import sync_folder

ExecutorName = Literal["processes", "dask"]


@dataclass(frozen=True)
class ExecutionSettings:
    """Settings of the execution of a campaign. They do not change its results.

    Attributes:
        output: the results folder.
        jobs: number of worker processes, 0 for one per core that this process may use.
        executor: 'processes' of this machine, or 'dask' for a cluster.
        scheduler: address of the Dask scheduler, only with 'dask'.
        resume: True to continue the study in the results folder.
        overwrite: True to remove the study in the results folder and begin anew.
    """

    output: Path
    jobs: Annotated[int, Range(0, 4096)] = 0
    executor: ExecutorName = "processes"
    scheduler: str | None = None
    resume: bool = False
    overwrite: bool = False

    def __post_init__(self) -> None:
        """Check every setting.

        Raises:
            SettingsError: a value is not allowed; the message states the allowed values.
        """
        require_allowed(self)
        if self.resume and self.overwrite:
            raise SettingsError(
                "--resume keeps results and --overwrite removes them: give one",
                code="resume-or-overwrite",
            )
        if (self.executor == "dask") != bool(self.scheduler):
            raise SettingsError(
                "the executor 'dask' needs a scheduler's address, and only it takes one: "
                "--executor dask --scheduler tcp://HOST:8786",
                code="scheduler",
            )


def workers_for(execution: ExecutionSettings) -> Workers:
    """Return the workers that the execution settings describe. They are not started yet."""
    if execution.executor == "dask":
        assert execution.scheduler is not None
        return DaskWorkers(execution.scheduler, environment)
    return LocalWorkers(execution.jobs)


CAMPAIGN_FORMAT = "dual-arm-carry campaign"
CAMPAIGN_VERSION = 2

_PACKAGES = ("casadi", "moocore", "numpy", "pin", "pymoo", "python-fcl", "scipy", "trimesh")


@cache
def environment() -> Mapping[str, str]:
    """Return, by name, the versions of the software that affects a search and a digest of this
    project's sources.
    """
    versions = {name: version(name) for name in _PACKAGES}
    versions["dual-arm-carry"] = own_version()  # beside the digest of the sources
    versions["sources"] = source_digest("symbolic", "codegen", "hybrid_opt")
    versions["python"] = platform.python_version()
    versions["machine"] = platform.machine()
    return versions


def configuration_of(settings: CampaignSettings, root: Path, workcell: Workcell) -> Configuration:
    """Return the record that identifies a campaign: its settings, its workcell, and the versions of
    the software.

    Args:
        settings: settings of the campaign.
        root: the results folder.
        workcell: the workcell, read from the copy in the results folder.
    """
    file = workcell.source.relative_to(root.resolve()).as_posix()
    cell = StoredCell(workcell.name, file, workcell.digest)
    return Configuration(CAMPAIGN_FORMAT, CAMPAIGN_VERSION, cell, settings, environment())


def require_equal(stored: Any, wanted: Mapping[str, Any], where: str) -> None:
    """Check that a stored configuration equals the current one.

    Args:
        stored: stored JSON values.
        wanted: current JSON values by name.
        where: name of the file or folder, for the error message.

    Raises:
        ResultsError: values differ; the message lists all of them.
    """
    listed = "\n".join(
        f"  - {key}: stored {json.dumps(old)}, now {json.dumps(new)}"
        for key, old, new in differences(stored, dict(wanted))
    )
    if listed:
        raise ResultsError(
            f"{where}: holds results of something else, and they are never mixed; choose another "
            "--output, remove them with --overwrite, or repeat the command with what they were "
            f"made with:\n{listed}",
            code="other-settings",
        )


def differences(first: Any, second: Any, key: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Yield the differences of two trees of JSON values.

    Args:
        first: tree of JSON values.
        second: tree to compare with `first`.
        key: key path of both trees, put in front of the yielded key paths.

    Yields:
        Key path joined by points, value in `first`, and value in `second`; a missing value is None.
    """
    if isinstance(first, dict) and isinstance(second, dict):
        for name in dict.fromkeys((*first, *second)):
            inner = f"{key}.{name}" if key else name
            yield from differences(first.get(name), second.get(name), inner)
    elif first != second:
        yield key, first, second


@dataclass(frozen=True)
class CampaignFolder:
    """An open results folder.

    Attributes:
        root: the folder.
        settings: settings of the campaign.
        execution: settings of the execution.
        cell: cell of the workcell copy in the folder, with the objectives of the settings.
        files: files of the workcell.
        workers: workers that run the computations of the stages.
    """

    root: Path
    settings: CampaignSettings
    execution: ExecutionSettings
    cell: Cell
    files: CellFiles
    workers: Workers

    @property
    def workcell(self) -> Workcell:
        """Description of the cell."""
        return self.cell.workcell


@contextmanager
def open_folder(
    settings: CampaignSettings,
    execution: ExecutionSettings,
    workcell: Workcell,
    workers: Workers | None = None,
) -> Iterator[CampaignFolder]:
    """Start or continue a campaign in its results folder, locked for the `with` block.

    Args:
        settings: settings of the campaign.
        execution: settings of the execution.
        workcell: the workcell of the campaign.
        workers: workers that run the computations of the stages. None starts the workers of the
            execution settings and ends them with the `with` block.

    Raises:
        ResultsError: the folder is in use, holds something else, or is to be continued but was
            made from another workcell, with other settings or other software.
    """
    root = execution.output
    files = collect_cell(workcell)
    with storing(root):
        root.mkdir(parents=True, exist_ok=True)
    with locked(root), ExitStack() as stack:
        require_usable(execution)
        if execution.overwrite:
            _clear(root)
        stored = read_json(root / CONFIGURATION) if (root / CONFIGURATION).exists() else None
        if stored is not None:
            digest = stored.get("workcell", {}).get("digest") if isinstance(stored, dict) else None
            if digest != files.digest:
                raise ResultsError(
                    f"{root}: holds results of another workcell, or of this one before a change; "
                    f"{_ELSEWHERE}",
                    code="another-workcell",
                )
        copy = _stored_cell(root, files)
        wanted = to_json(configuration_of(settings, root, copy))
        if stored is None:
            write_json(root / CONFIGURATION, wanted)
        else:
            require_equal(stored, wanted, str(root))
        if workers is None:
            workers = stack.enter_context(workers_for(execution))
        cell = Cell(copy, settings.objectives)
        yield CampaignFolder(root, settings, execution, cell, files, workers)


def require_usable(execution: ExecutionSettings) -> None:
    """Check that the results folder in the execution settings can be used.

    Raises:
        ResultsError: the folder contains a campaign and neither `resume` nor `overwrite` is set, or
            it contains other files.
    """
    root = execution.output
    if (root / CONFIGURATION).exists():
        if not (execution.resume or execution.overwrite):
            raise ResultsError(
                f"{root}: holds a campaign already; continue it with --resume, or {_ELSEWHERE}",
                code="folder-in-use",
            )
        return
    entries = root.iterdir() if root.is_dir() else ()
    strays = [entry.name for entry in entries if entry.name != WORKCELL]
    strays = [name for name in strays if not name.startswith(".")]
    if strays:
        raise ResultsError(
            f"{root}: is no results folder, but not empty ({', '.join(sorted(strays)[:3])}); "
            "choose another --output",
            code="not-empty",
        )


_ELSEWHERE = "choose another --output, or remove those results with --overwrite"


def _clear(root: Path) -> None:
    """Remove everything in a results folder.

    Markers of finished stages are removed first and the configuration last. So after an
    interruption no stage with missing files is marked as finished, and the folder can be
    overwritten again.
    """
    order = {STAGES: 0, CONFIGURATION: 2}
    with storing(root):
        for entry in sorted(root.iterdir(), key=lambda entry: order.get(entry.name, 1)):
            if entry.is_dir() and not entry.is_symlink():
                shutil.rmtree(entry)
            elif entry.name != LOCK:
                entry.unlink()


def _stored_cell(root: Path, files: CellFiles) -> Workcell:
    """Return the workcell in a results folder. If it is missing, the given files are copied there
    before.

    Args:
        root: the results folder.
        files: files of the workcell.

    Raises:
        ResultsError: the workcell in the folder was changed after the campaign began.
    """
    folder = root / WORKCELL
    if not folder.exists():
        draft = root / f".{WORKCELL}"
        with storing(folder):
            shutil.rmtree(draft, ignore_errors=True)
            draft.mkdir()
            unpack_cell(files, draft)
            os.replace(draft, folder)
            sync_folder(root)
    workcell = load(folder / files.workcell)
    if workcell.digest != files.digest:
        raise ResultsError(
            f"{folder}: was changed after the campaign began; {_ELSEWHERE}", code="changed-workcell"
        )
    return workcell
