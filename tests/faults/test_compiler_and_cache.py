"""Compilers that lie, hang or are misspelt, and a cache that something happened to."""

from __future__ import annotations

import fcntl
import os
import subprocess
import sys
import time
from pathlib import Path

import casadi as ca
import pytest

from codegen.build import build
from codegen.cache import Cache, digest
from codegen.errors import CodegenError
from tests.waiting import soon

KEY = digest("fault")
ASKED = '#!/bin/sh\ncase "$*" in -v|*" -E "*) exec gcc "$@" ;; esac\n'
OUTPUT = 'while [ "$1" != "-o" ]; do shift; done\n'


def square() -> dict[str, ca.Function]:
    x = ca.SX.sym("x")
    return {"square": ca.Function("square", [x], [x**2], ["x"], ["y"])}


def compiler(folder: Path, monkeypatch: pytest.MonkeyPatch, script: str) -> None:
    """Let CC name a compiler that answers questions as gcc does, and compiles by this script."""
    path = folder / "odd-cc"
    path.write_text(ASKED + script)
    path.chmod(0o755)
    monkeypatch.setenv("CC", str(path))


@pytest.mark.parametrize(
    ("script", "words"),
    [
        ("exit 0\n", "reported success but made no library"),
        (OUTPUT + ': > "$2"\n', "reported success but made no library"),
        (OUTPUT + 'echo nonsense > "$2"\n', "the compiled library cannot be loaded"),
        (OUTPUT + 'cp /bin/ls "$2"\n', "the compiled library cannot be loaded"),
        ("kill -9 $$\n", "was ended by signal 9"),
        ("exit 3\n", "failed at square.c: no message"),
    ],
)
def test_a_compiler_that_lies_or_dies_is_told(
    cache: Cache, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, script: str, words: str
) -> None:
    compiler(tmp_path, monkeypatch, script)
    for _ in range(2):  # nothing of it may be taken for a library the second time
        with pytest.raises(CodegenError, match=words):
            build(square(), cache)
    monkeypatch.delenv("CC")
    assert build(square(), cache).functions["square"](3.0)["y"] == 9.0


def test_a_compiler_that_hangs_is_ended(
    cache: Cache, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("codegen.compiler.MOST_SECONDS", 0.5)
    compiler(tmp_path, monkeypatch, "exec sleep 60\n")
    with soon(), pytest.raises(CodegenError, match=r"took longer than 0\.5 s over square\.c"):
        build(square(), cache)


def test_a_misspelt_compiler_is_told(cache: Cache, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", "gcc '-O2")
    with pytest.raises(CodegenError, match=r"CC holds .* which is no command"):
        build(square(), cache)


@pytest.mark.parametrize("kind", ["pipe", "folder", "deep", "other", "outside"])
def test_records_that_are_none_are_not_found(cache: Cache, kind: str) -> None:
    build(square(), cache)
    # Beside it lies which compiler there is.
    (record,) = [p for p in cache.folder.glob("*.json") if '"library"' in p.read_text("utf-8")]
    name = record.name
    record.unlink()
    match kind:
        case "pipe":
            os.mkfifo(record, 0o600)
        case "folder":
            record.mkdir(mode=0o700)
        case "deep":
            record.write_bytes(b"[" * 100_000)
        case "other":
            cache.write_record(name.removesuffix(".json"), {"library": 5})
        case "outside":
            cache.write_record(name.removesuffix(".json"), {"library": "../x", "sha256": ""})
    assert cache.find(name.removesuffix(".json")) is None


def _made(library: Path) -> dict[str, object]:
    library.write_bytes(b"made")
    return {}


@pytest.mark.parametrize("jump", [-2 * 86400.0, 2 * 86400.0])
def test_a_clock_that_jumps_ends_no_living_build(cache: Cache, jump: float) -> None:
    cache.write_record(KEY, {})
    living, dead = cache.folder / "build-living", cache.folder / "build-dead"
    for folder in (living, dead):
        folder.mkdir(mode=0o700)
        os.utime(folder, (time.time() + jump,) * 2)
    handle = os.open(living, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        cache.store(KEY, _made)  # sweeps
    finally:
        os.close(handle)
    assert living.exists()
    assert not dead.exists()


def test_a_build_holds_its_folder(cache: Cache) -> None:
    def make(library: Path) -> dict[str, object]:
        os.utime(library.parent, (0.0, 0.0))
        Cache(cache.folder).store(digest("other"), _made)  # sweeps
        library.write_bytes(b"made")
        return {}

    assert cache.store(KEY, make).library.read_bytes() == b"made"


def test_a_cache_on_a_read_only_place_is_told() -> None:
    """Nobody may write below /proc, not even root."""
    program = (
        "import casadi as ca\nfrom codegen.build import compile_function\n"
        "x = ca.SX.sym('x')\n"
        "from codegen.errors import CodegenError\n"
        "try:\n    compile_function(ca.Function('f', [x], [x]))\n"
        "except CodegenError as error:\n    print(error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program],
        env=os.environ | {"DUAL_ARM_CACHE": "/proc/no/cache"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert "cannot be used: /proc" in done.stdout
    assert "DUAL_ARM_CACHE" in done.stdout
    assert len(done.stdout.splitlines()) == 1
