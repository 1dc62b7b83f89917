"""Writing a file in one step: the one atomic write, which every layer's own errors surround."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO


def replace_file(path: Path, content: bytes, mode: int = 0o666) -> None:
    """Replace a file durably: an interruption at any moment leaves the old content or the new one.

    The new content is written beside it first, as `.NAME.draft`; whoever writes the same file
    meanwhile waits. What an ended process left there is overwritten.

    Args:
        path: the file, in an existing folder.
        content: of the file.
        mode: permissions of the file, as far as the process's mask allows them.

    Raises:
        OSError: it cannot be written; what was written beside it is removed.
    """
    draft = path.with_name(f".{path.name}.draft")
    with _alone(draft, mode) as file:
        try:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
            os.replace(draft, path)
        except OSError:
            with suppress(OSError):
                draft.unlink()
            raise
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Make a folder's entries durable.

    Raises:
        OSError: there is none, or the disk does not take them.
    """
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextmanager
def _alone(draft: Path, mode: int) -> Iterator[BinaryIO]:
    """A new, empty file that nobody else writes, as far as the file system has locks."""
    while True:
        with open(os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW, mode), "wb") as file:
            with suppress(OSError):
                fcntl.flock(file, fcntl.LOCK_EX)
            if _is_still(draft, file):
                file.truncate(0)
                yield file
                return


def _is_still(draft: Path, file: BinaryIO) -> bool:
    """False where whoever held the lock before has renamed what was opened: it is theirs."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), draft.stat(follow_symlinks=False))
    except FileNotFoundError:
        return False
