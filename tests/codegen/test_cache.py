"""The cache: found again, never trusted when damaged, unsafe or half written."""

from __future__ import annotations

import fcntl
import os
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path

import pytest

from codegen.cache import Cache, default_folder, digest, key_of
from codegen.errors import CodegenError
from tests.refusals import refused
from tests.waiting import HANGS

KEY = digest("test")


def put(cache: Cache, content: bytes = b"library", key: str = KEY) -> Path:
    """Store a library of this content."""

    def make(path: Path) -> Mapping[str, object]:
        path.write_bytes(content)
        return {"note": "made"}

    return cache.store(key, make).library


def test_found_as_stored(cache: Cache) -> None:
    assert cache.find(KEY) is None
    library = put(cache)
    entry = cache.find(KEY)
    assert entry is not None
    assert entry.library == library
    assert entry.facts["note"] == "made"
    assert library.read_bytes() == b"library"
    assert cache.find(digest("another")) is None


def test_private_to_the_user_whatever_the_umask(cache: Cache) -> None:
    before = os.umask(0o000)
    try:
        put(cache)
    finally:
        os.umask(before)
    assert cache.folder.stat().st_mode & 0o777 == 0o700
    assert all(path.stat().st_mode & 0o077 == 0 for path in cache.folder.iterdir())
    assert cache.find(KEY) is not None


@pytest.mark.parametrize("damage", [b"", b"librarx", b"library and more"])
def test_damaged_library_is_not_found(cache: Cache, damage: bytes) -> None:
    library = put(cache)
    library.write_bytes(damage)
    assert cache.find(KEY) is None
    put(cache)
    assert cache.find(KEY) is not None


TEXTS = ("{", '{"facts": {}, "sha256": "0"}', "null", "\xff", "mads", "[" * 100_000)
RECORDS = ({"library": 5}, {"library": "../x", "sha256": ""})


@pytest.mark.parametrize("damage", [*TEXTS, *RECORDS, "pipe", "folder"])
def test_damaged_manifest_is_not_found(cache: Cache, damage: str | dict[str, object]) -> None:
    """Also one that says something plausible, but not what was written."""
    put(cache)
    manifest = cache.folder / f"{KEY}.json"
    text = manifest.read_text()
    manifest.unlink()
    match damage:
        case "pipe":
            os.mkfifo(manifest, 0o600)
        case "folder":
            manifest.mkdir()
        case "mads":
            manifest.write_text(text.replace("made", "mads"))
        case str():
            manifest.write_text(damage, encoding="latin-1")
        case _:
            cache.write_record(KEY, damage)
    assert cache.find(KEY) is None


def test_failed_build_leaves_nothing(cache: Cache) -> None:
    def fail(path: Path) -> Mapping[str, object]:
        path.write_bytes(b"half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        cache.store(KEY, fail)
    assert cache.find(KEY) is None
    assert list(cache.folder.iterdir()) == []


@pytest.mark.parametrize("jump", [-2 * 86400.0, 2 * 86400.0])
def test_what_killed_builds_left_is_swept_when_old(cache: Cache, jump: float) -> None:
    """But for living builds, whatever the clock says."""
    put(cache)
    living, dead, young = (cache.folder / f"build-{name}" for name in ("living", "dead", "young"))
    for folder in (living, dead, young):
        folder.mkdir(mode=0o700)
        (folder / "library.so").write_bytes(b"half")
        if folder is not young:
            os.utime(folder, (time.time() + jump,) * 2)
    handle = os.open(living, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        put(cache)
    finally:
        os.close(handle)
    assert living.exists()
    assert not dead.exists()
    assert young.exists()


def test_a_build_holds_its_folder(cache: Cache) -> None:
    def make(library: Path) -> dict[str, object]:
        os.utime(library.parent, (0.0, 0.0))
        put(Cache(cache.folder), key=digest("other"))  # sweeps
        library.write_bytes(b"made")
        return {}

    assert cache.store(KEY, make).library.read_bytes() == b"made"


@pytest.mark.parametrize("mode", [0o777, 0o770, 0o707, 0o722])
def test_folder_that_others_can_write_to_is_refused(cache: Cache, mode: int) -> None:
    put(cache)
    cache.folder.chmod(mode)
    for use in (lambda: cache.find(KEY), lambda: put(cache), cache.clean):
        with refused(CodegenError, "writable-by-others", "chmod go-w", "DUAL_ARM_CACHE"):
            use()
    cache.folder.chmod(0o755)
    assert cache.find(KEY) is not None


@pytest.mark.parametrize("suffix", ["so", "json"])
def test_file_that_others_can_write_to_is_refused(cache: Cache, suffix: str) -> None:
    put(cache)
    next(cache.folder.glob(f"*.{suffix}")).chmod(0o666)
    with refused(CodegenError, "writable-by-others"):
        cache.find(KEY)


def test_parent_in_which_others_can_exchange_the_folder_is_refused(tmp_path: Path) -> None:
    shared = tmp_path / "shared"
    shared.mkdir()
    cache = Cache(shared / "cache")
    put(cache)
    shared.chmod(0o777)
    with refused(CodegenError, "exchangeable-by-others", shared):
        cache.find(KEY)
    shared.chmod(0o1777)  # only owners may rename there, as in /tmp
    assert cache.find(KEY) is not None
    shared.chmod(0o777)
    link = tmp_path / "link"
    link.symlink_to(shared / "cache")
    with refused(CodegenError, "exchangeable-by-others", shared):
        Cache(link).find(KEY)


def test_foreign_folder_is_refused(cache: Cache, monkeypatch: pytest.MonkeyPatch) -> None:
    put(cache)
    own = os.geteuid()
    monkeypatch.setattr(os, "geteuid", lambda: own + 1)
    with refused(CodegenError, "owned-by-another", f"user {own}"):
        cache.find(KEY)


def test_a_place_that_cannot_hold_it_is_told(tmp_path: Path) -> None:
    """A file, what is below one, and where nobody may write, not even root."""
    file = tmp_path / "file"
    file.write_text("")
    for place in (file, file / "below", Path("/proc/no/cache")):
        with pytest.raises(CodegenError, match=rf"{place}.*DUAL_ARM_CACHE") as told:
            put(Cache(place))
        assert "\n" not in str(told.value)


def test_full_disk_is_one_message(tmp_path: Path) -> None:
    """A process that may write no file beyond 4 kB meets the error of a full disk."""
    program = """
import resource, sys
from pathlib import Path
from codegen.cache import Cache
from codegen.errors import CodegenError
resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
def make(path):
    path.write_bytes(b"x" * 100_000)
    return {}
try:
    Cache(Path(sys.argv[1])).store("0" * 64, make)
except CodegenError as error:
    print(error.code, error)
"""
    folder = tmp_path / "cache"
    done = subprocess.run(
        [sys.executable, "-c", program, str(folder)], capture_output=True, text=True, check=True
    )
    assert done.stdout.startswith("cache-unusable ")
    assert "DUAL_ARM_CACHE" in done.stdout
    assert done.stdout.count("\n") == 1
    assert list(folder.iterdir()) == []


def test_clean_removes_all_of_ours_and_nothing_else(cache: Cache) -> None:
    assert cache.clean() == 0
    put(cache)
    with cache.lock(KEY):
        pass
    (cache.folder / "build-left").mkdir()
    (cache.folder / "notes.txt").write_text("kept")
    assert cache.clean() == 1
    assert [path.name for path in cache.folder.iterdir()] == ["notes.txt"]


def test_lock_keeps_others_out(cache: Cache) -> None:
    program = """
import sys
from pathlib import Path
from codegen.cache import Cache
cache = Cache(Path(sys.argv[1]))
print("waiting", flush=True)
with cache.lock("key"):
    print("inside", flush=True)
"""
    with cache.lock("key"):
        other = subprocess.Popen(
            [sys.executable, "-c", program, str(cache.folder)], stdout=subprocess.PIPE, text=True
        )
        assert other.stdout is not None
        assert other.stdout.readline() == "waiting\n"
        with pytest.raises(subprocess.TimeoutExpired):
            other.wait(timeout=0.5)
    assert other.communicate(timeout=HANGS)[0] == "inside\n"


def test_default_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    monkeypatch.delenv("DUAL_ARM_CACHE", raising=False)
    if sys.platform.startswith("linux"):
        assert default_folder() == tmp_path / "xdg" / "dual-arm-carry"
    monkeypatch.setenv("DUAL_ARM_CACHE", str(tmp_path / "own"))
    assert default_folder() == tmp_path / "own"


def test_code_digest_follows_what_the_source_does(
    cache: Cache, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = tmp_path / "some_module.py"
    monkeypatch.syspath_prepend(tmp_path)
    texts = (
        "X = 1\n",
        '"""Said."""\n\nX = 1  # more\n"""Also said."""\n',
        "X = 2\n",
        "X = 'said'\n",
        "def f():\n    return 1\n",
        'def f():\n    """Said."""\n    return 1\n',
    )
    found = []
    for text in texts:
        module.write_text(text)
        found.append(cache.code_digest("some_module"))
        assert cache.code_digest("some_module") == found[-1]
    one, same, two, three, four, same_as_four = found
    assert one == same
    assert four == same_as_four
    assert len({one, two, three, four}) == 4


def test_keys_tell_names_and_values_apart() -> None:
    keys = [key_of("set", a="x"), key_of("set", b="x"), key_of("set", a="y"), key_of("part", a="x")]
    keys += [key_of("set", a="x", b="y"), key_of("set", a="x", b=("y",))]
    assert len(set(keys)) == len(keys)
    assert key_of("set", b=2, a=1) == key_of("set", a=1, b=2)


def test_what_was_not_used_for_longest_goes_first(
    cache: Cache, monkeypatch: pytest.MonkeyPatch
) -> None:
    keys = [digest(name) for name in ("first", "second", "third")]
    now = time.time()
    for days, key in zip((3.0, 2.0, 1.0), keys, strict=True):
        put(cache, b"x" * 1000, key)
        for path in cache.folder.glob(f"{key}*"):
            os.utime(path, (now - 86400.0 * days,) * 2)
    assert cache.find(keys[0]) is not None  # which is a use
    usage = cache.usage()
    assert (usage.libraries, usage.files) == (3, 6)
    assert usage.size == sum(path.stat().st_size for path in cache.folder.iterdir())
    assert cache.trim(usage.size) == 0
    assert cache.trim(usage.size - 1) == 1
    assert [cache.find(key) is not None for key in keys] == [True, False, True]
    monkeypatch.setenv("DUAL_ARM_CACHE_LIMIT", "1e-6")
    assert cache.trim() == 2
    assert cache.usage().files == 0
    monkeypatch.setenv("DUAL_ARM_CACHE_LIMIT", "much")
    with refused(CodegenError, "cache-limit", "'much'"):
        cache.trim()
