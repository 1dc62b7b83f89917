"""The results folder of a campaign, held by one process while it works."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from hybrid_opt.campaign.execution import ExecutionSettings
from hybrid_opt.campaign.identity import identity, require_equal
from hybrid_opt.campaign.layout import CONFIGURATION, WORKCELL
from hybrid_opt.campaign.settings import CampaignSettings
from hybrid_opt.cell import Cell
from hybrid_opt.errors import ResultsError
from hybrid_opt.store.files import locked, read_json, storing, write_json
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
        configuration = root / CONFIGURATION
        exists = configuration.exists()
        _check_use(root, exists, execution.resume)
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
                    "choose another --output"
                )
        copy = _stored_cell(root, files)
        if not exists:
            write_json(configuration, identity(settings, root, copy))
        yield CampaignFolder(root, settings, execution, Cell(copy, settings.objectives), files)


def _check_use(root: Path, exists: bool, resume: bool) -> None:
    if exists and not resume:
        raise ResultsError(
            f"{root}: holds a campaign already; continue it with --resume, or choose another "
            "--output"
        )
    strays = [entry.name for entry in root.iterdir() if entry.name not in (".lock", WORKCELL)]
    strays = [name for name in strays if not name.startswith(".")]
    if not exists and strays:
        raise ResultsError(
            f"{root}: is no results folder, but not empty ({', '.join(sorted(strays)[:3])}); "
            "choose another --output"
        )


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
        raise ResultsError(
            f"{folder}: was changed after the campaign began; choose another --output"
        )
    return workcell
