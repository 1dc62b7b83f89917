"""Full disks, read-only and foreign folders: real file systems and a real other user."""

from __future__ import annotations

import errno
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from hybrid_opt.errors import ResultsError
from hybrid_opt.store.bundle_file import read_manifest, write_bundle
from hybrid_opt.store.files import read_json, sha256, write_atomically, write_json
from hybrid_opt.store.trajectory_file import read_trajectory, write_trajectory
from tests.faults.test_kills import contents, differences, ended, started, study
from tests.refusals import refused
from tests.symbolic.cells import ROOT, rack_cell
from tests.waiting import HANGS

NOBODY = 65534
DENIED = os.strerror(errno.EACCES)
TINY = "256k"


def _mounted(folder: Path, options: str) -> bool:
    command = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)]
    try:
        return subprocess.run(command, capture_output=True, check=False).returncode == 0
    except OSError:
        return False


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 256 KiB; skipped where none can be mounted."""
    folder = tmp_path / "disk"
    folder.mkdir()
    if not _mounted(folder, f"size={TINY},mode=700"):
        pytest.skip("no file system can be mounted here")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=False)


def remount(disk: Path, options: str) -> None:
    """Make the file system larger, read-only or writable."""
    subprocess.run(["mount", "-o", f"remount,{options}", str(disk)], check=True)


def fill(disk: Path) -> None:
    """Leave no room."""
    with open(disk / "filler", "wb", buffering=0) as file:
        try:
            while True:
                file.write(b"x" * 4096)
        except OSError:
            return


Writer = Callable[[Path], None]


def _trajectory(path: Path) -> None:
    write_trajectory(path, rack_cell(), rack_cell().task.initial.ravel(), {"duration": 1.0}, {})


def _bundle(path: Path) -> None:
    write_bundle(path, {"sub/job.csv": "x" * 500_000}, {})


WRITERS: dict[str, Writer] = {
    "content": lambda path: write_atomically(path, b"x" * 500_000),
    "json": lambda path: write_json(path, ["x" * 500_000]),
    "trajectory": _trajectory,
    "bundle": _bundle,
}


@pytest.mark.parametrize("kind", WRITERS)
def test_a_full_disk_is_told_and_what_was_there_is_kept(disk: Path, kind: str) -> None:
    path = disk / "file"
    write_json(disk / "before.json", {"kept": True})
    fill(disk)
    with refused(ResultsError, "no-space", "file: "):
        WRITERS[kind](path)
    assert read_json(disk / "before.json") == {"kept": True}
    (disk / "filler").unlink()
    remount(disk, "size=4m")
    WRITERS[kind](path)
    assert path.exists()
    assert [entry.name for entry in disk.iterdir() if entry.name.endswith((".draft", ".1"))] == []


@pytest.mark.parametrize("kind", WRITERS)
def test_a_read_only_disk_is_told(disk: Path, kind: str) -> None:
    remount(disk, "ro")
    with refused(ResultsError, "not-writable", "file: ", os.strerror(errno.EROFS)):
        WRITERS[kind](disk / "file")


def test_a_trajectory_is_replaced_only_by_a_whole_one(disk: Path) -> None:
    path = disk / "trajectory.json"
    _trajectory(path)
    fill(disk)
    with refused(ResultsError, "no-space"):
        _trajectory(path)
    assert read_trajectory(path).figures == {"duration": 1.0}


def test_a_bundle_is_replaced_only_by_a_whole_one(disk: Path) -> None:
    """An export has no --resume: its message does not speak of one."""
    folder = disk / "bundle"
    write_bundle(folder, {"job.csv": "before"}, {})
    fill(disk)
    with refused(ResultsError, "no-space"):
        write_bundle(folder, {"job.csv": "x" * 500_000}, {})
    assert read_manifest(folder)["files"] == {"job.csv": sha256(b"before")}
    assert (folder / "job.csv").read_text() == "before"
    assert {entry.name for entry in disk.iterdir()} == {"bundle", "filler"}


TELL = f"""
import os, sys
from pathlib import Path
from symbolic.errors import DualArmError
from hybrid_opt.store.files import read_json, write_json
from codegen.cache import Cache
from symbolic.read.cell import load
path = Path(sys.argv[1])
# What was imported stays, also where the other user may not read the environment.
os.setgroups([])
os.setresgid({NOBODY}, {NOBODY}, {NOBODY})
os.setresuid({NOBODY}, {NOBODY}, {NOBODY})
try:
    ACTION
except DualArmError as error:
    print(error.code, error)
"""


@pytest.mark.parametrize(
    ("action", "code", "quoted"),
    [
        ("write_json(path / 'new.json', 1)", "not-writable", f"new.json: .*{DENIED}"),
        ("read_json(path / 'own.json')", "unreadable", f"own.json: .*{DENIED}"),
        ("load(path / 'own.json')", "unreadable", f"file: .*{DENIED}"),
        ("Cache(path).read_record('0' * 64)", "owned-by-another", f" 0, .*{NOBODY}"),
        ("Cache(path / 'cache').write_record('0' * 64, {})", "cache-unusable", DENIED),
    ],
)
def test_folders_of_others_are_told(action: str, code: str, quoted: str) -> None:
    if os.geteuid() != 0:
        pytest.skip("only root can become another user")
    folder = Path("/tmp") / f"of-another-{os.getpid()}"  # the tests' own folder is closed to others
    folder.mkdir(mode=0o755)
    try:
        (folder / "own.json").write_text("{}")
        (folder / "own.json").chmod(0o600)
        done = subprocess.run(
            [sys.executable, "-c", TELL.replace("ACTION", action), str(folder)],
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=False,
            timeout=HANGS,
        )
        assert re.match(f"{code} (?s:.*){quoted}", done.stdout), done.stdout + done.stderr
        assert done.stderr == ""
    finally:
        shutil.rmtree(folder)


@pytest.mark.slow
def test_a_study_goes_on_when_there_is_room_again(disk: Path, tmp_path: Path) -> None:
    """The same bits as on a disk that was never full."""
    said = tmp_path / "said"
    assert ended(started(study(tmp_path / "peace", False, False), said), said) == 0
    output = disk / "results"
    codes = []
    for size in ("256k", "320k", "384k", "512k", "1m", "16m"):
        remount(disk, f"size={size}")
        codes.append(ended(started(study(output, output.exists(), False), said), said))
        if codes[-1] == 2:
            assert "--resume" in said.read_text()
        if codes[-1] == 0:
            break
    assert codes[0] == 2
    assert codes[-1] == 0
    assert differences(contents(tmp_path / "peace"), contents(output)) == []
