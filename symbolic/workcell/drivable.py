"""The drivable variant of a workcell: the same cell under the time law 'optimal'.

Its file is the original's text with one key changed, comments and all else as they were.
"""

from __future__ import annotations

import copy
import re
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from symbolic.errors import BundleError
from symbolic.workcell.cell_files import CellFiles, unpack_cell
from symbolic.workcell.references import parse_toml

LAW = "optimal"
_TASK = re.compile(r"^[ \t]*\[[ \t]*task[ \t]*\][^\n]*$", re.MULTILINE)
_LAW = re.compile(r"^([ \t]*)time_law[ \t]*=[^\n]*$", re.MULTILINE)
_TABLE = re.compile(r"^[ \t]*\[{1,2}[ \t]*[A-Za-z_][\w. \t-]*\]{1,2}[ \t]*(#.*)?$", re.MULTILINE)


def drivable_files(stored: CellFiles) -> CellFiles:
    """The files of a cell (`symbolic.workcell.cell_files.collect_cell`) under 'optimal'.

    Raises:
        BundleError: the file writes the task in a way that cannot be changed line by line, or the
            changed cell is not valid.
    """
    content = stored.files[stored.workcell]
    wanted = copy.deepcopy(parse_toml(content))
    if isinstance(wanted.get("task"), dict):
        wanted["task"]["time_law"] = LAW
    changed = _with_law(content.decode("utf-8")).encode()
    try:
        as_wanted = parse_toml(changed) == wanted
    except BundleError:
        as_wanted = False
    if not as_wanted:
        raise BundleError(
            f"{stored.workcell}: the time law cannot be changed in it; begin its task with a line "
            "[task], and write time_law = ... on a line of its own"
        )
    draft = replace(stored, files={**stored.files, stored.workcell: changed}, digest="")
    with TemporaryDirectory() as folder:
        digest = unpack_cell(draft, Path(folder), check_digest=False).digest
    return replace(draft, digest=digest)


def _with_law(text: str) -> str:
    """The text with its task's time law replaced, or written below the task's heading."""
    heading = _TASK.search(text)
    if heading is None:
        return text
    begin = heading.end()
    following = _TABLE.search(text, begin)
    end = following.start() if following else len(text)
    task, count = _LAW.subn(rf'\1time_law = "{LAW}"', text[begin:end], count=1)
    if not count:
        task = f'\ntime_law = "{LAW}"{text[begin:end]}'
    return text[:begin] + task + text[end:]
