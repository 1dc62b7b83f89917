"""The results folder of a campaign, held by one process while it works."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from hybrid_opt.campaign.documents import CONFIGURATION, STAGES, WORKCELL
from hybrid_opt.campaign.execution import ExecutionSettings
from hybrid_opt.campaign.identity import identity, require_equal
from hybrid_opt.campaign.settings import CampaignSettings
from hybrid_opt.cell import Cell
from hybrid_opt.errors import ResultsError
from hybrid_opt.store.files import LOCK, locked, read_json, storing, write_json
from symbolic.read.cell import load
from symbolic.read.cell_files import CellFiles, collect_cell, unpack_cell
from symbolic.records import Workcell
from symbolic.replacing import sync_folder


@dataclass(frozen=True)
class CampaignFolder:
    """An open results folder.

    Attributes:
        root: the folder.
        settings: what is computed.
        execution: how.
        cell: of the folder's own copy of the workcell, with the settings' objectives.
        files: the workcell's files.
    """

    root: Path
    settings: CampaignSettings
    execution: ExecutionSettings
    cell: Cell
    files: CellFiles

    @property
    def workcell(self) -> Workcell:
        """The cell's description."""
        return self.cell.workcell


@contextmanager
def open_folder(
    settings: CampaignSettings, execution: ExecutionSettings, workcell: Workcell
) -> Iterator[CampaignFolder]:
    """Start or continue a campaign in its results folder, locked for the `with` block.

    Raises:
        ResultsError: the folder is in use, holds something else, or is to be continued but was
            made from another workcell, with other settings or other software.
    """
    root = execution.output
    files = collect_cell(workcell)
    with storing(root):
        root.mkdir(parents=True, exist_ok=True)
    with locked(root):
        require_usable(execution)
        if execution.overwrite:
            _clear(root)
        configuration = root / CONFIGURATION
        exists = configuration.exists()
        if exists:
            stored = read_json(configuration)
            digest = stored.get("workcell", {}).get("digest") if isinstance(stored, dict) else None
            if digest == files.digest:
                require_equal(
                    stored, identity(settings, root, _stored_cell(root, files)), str(root)
                )
            else:
                raise ResultsError(
                    f"{root}: holds results of another workcell, or of this one before a change; "
                    f"{_ELSEWHERE}"
                )
        copy = _stored_cell(root, files)
        if not exists:
            write_json(configuration, identity(settings, root, copy))
        yield CampaignFolder(root, settings, execution, Cell(copy, settings.objectives), files)


def require_usable(execution: ExecutionSettings) -> None:
    """Refuse a results folder that may not be worked in, before any work.

    Raises:
        ResultsError: it holds a campaign that is neither to be continued nor overwritten, or
            something else.
    """
    root = execution.output
    if (root / CONFIGURATION).exists():
        if not (execution.resume or execution.overwrite):
            raise ResultsError(
                f"{root}: holds a campaign already; continue it with --resume, or {_ELSEWHERE}"
            )
        return
    entries = root.iterdir() if root.is_dir() else ()
    strays = [entry.name for entry in entries if entry.name != WORKCELL]
    strays = [name for name in strays if not name.startswith(".")]
    if strays:
        raise ResultsError(
            f"{root}: is no results folder, but not empty ({', '.join(sorted(strays)[:3])}); "
            "choose another --output"
        )


_ELSEWHERE = "choose another --output, or remove those results with --overwrite"


def _clear(root: Path) -> None:
    """Remove all that a results folder holds.

    Marks of what is done go first and the configuration last: whatever moment ends it, nothing
    looks done that is not there, and the folder can be overwritten again.
    """
    order = {STAGES: 0, CONFIGURATION: 2}
    with storing(root):
        for entry in sorted(root.iterdir(), key=lambda entry: order.get(entry.name, 1)):
            if entry.is_dir() and not entry.is_symlink():
                shutil.rmtree(entry)
            elif entry.name != LOCK:
                entry.unlink()


def _stored_cell(root: Path, files: CellFiles) -> Workcell:
    """The folder's copy of the workcell, made where it is missing."""
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
        raise ResultsError(f"{folder}: was changed after the campaign began; {_ELSEWHERE}")
    return workcell
