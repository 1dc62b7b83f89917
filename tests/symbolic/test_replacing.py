"""A file is replaced whole or not at all, whoever else writes it."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from symbolic.replacing import replace_file


def test_content_and_permissions_are_those_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "file"
    replace_file(path, b"long content")
    replace_file(path, b"short", 0o600)
    assert path.read_bytes() == b"short"
    assert path.stat().st_mode & 0o777 == 0o600
    assert os.listdir(tmp_path) == ["file"]


def test_a_failure_leaves_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "file"
    replace_file(path, b"old")

    def full(handle: int) -> None:
        raise OSError("full")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="full"):
        replace_file(path, b"new")
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["file"]


def test_what_a_killed_process_left_is_overwritten(tmp_path: Path) -> None:
    (tmp_path / ".file.draft").write_bytes(b"half of something much longer")
    replace_file(tmp_path / "file", b"whole")
    assert (tmp_path / "file").read_bytes() == b"whole"
    assert os.listdir(tmp_path) == ["file"]


def test_a_link_in_place_of_the_draft_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "other").write_bytes(b"other")
    (tmp_path / ".file.draft").symlink_to(tmp_path / "other")
    with pytest.raises(OSError, match=r"\.file\.draft"):
        replace_file(tmp_path / "file", b"new")
    assert (tmp_path / "other").read_bytes() == b"other"


def test_many_writers_leave_one_content_whole(tmp_path: Path) -> None:
    path = tmp_path / "file"
    contents = [bytes([65 + k]) * (1000 + 7777 * k) for k in range(8)]
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda content: replace_file(path, content), 25 * contents))
    assert path.read_bytes() in contents
    assert os.listdir(tmp_path) == ["file"]


def test_a_missing_folder_is_told(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        replace_file(tmp_path / "none" / "file", b"")
