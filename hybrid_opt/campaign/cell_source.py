"""A workcell as a value that goes to any process or machine, and resources made from it there."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeVar

from symbolic.read.cell_files import CellFiles, cell_from_json, cell_to_json, unpack_cell
from symbolic.records import Workcell

Made = TypeVar("Made")


@dataclass(frozen=True)
class PackedCell:
    """A workcell with its files.

    Attributes:
        text: JSON of `symbolic.read.cell_files.cell_to_json`.
    """

    text: str

    @classmethod
    def of(cls, files: CellFiles) -> PackedCell:
        """The value for a stored workcell."""
        return cls(json.dumps(cell_to_json(files)))

    def make(self, of_workcell: Callable[[Workcell], Made]) -> Made:
        """Result of a function of the workcell, whose files exist only as long as it runs."""
        with TemporaryDirectory() as folder:
            return of_workcell(unpack_cell(cell_from_json(json.loads(self.text)), Path(folder)))
