"""Sets of functions: built once, found again, safe beside other builds and after dead ones."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from codegen import compiler
from codegen.build import build, compile_function, load_or_build
from codegen.cache import Cache
from codegen.compiled import CompiledFunction
from codegen.compiler import find_compiler
from codegen.errors import CodegenError
from tests.waiting import HANGS, until

SET = """
import casadi as ca
x = ca.MX.sym("x", 4)
functions = {
    "square": ca.Function("square", [x], [x**2], ["x"], ["y"]),
    "norm": ca.Function("norm", [x], [ca.norm_2(x)], ["x"], ["y"]),
}
"""


def functions() -> dict[str, ca.Function]:
    scope: dict[str, dict[str, ca.Function]] = {}
    exec(SET, scope)
    return scope["functions"]


def run(program: str, *arguments: object, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", program, *map(str, arguments)],
        env=os.environ | environment,
        capture_output=True,
        text=True,
        timeout=HANGS,
        check=False,
    )


def test_second_build_comes_from_the_cache(cache: Cache) -> None:
    first, second = build(functions(), cache), build(functions(), cache)
    assert [report.from_cache for report in first.reports] == [False, False]
    assert [report.from_cache for report in second.reports] == [True, True]
    for one, other in zip(first.reports, second.reports, strict=True):
        assert one.compile_seconds == other.compile_seconds > 0.0
        assert (one.name, one.operations, one.c_bytes) == (
            other.name,
            other.operations,
            other.c_bytes,
        )
    rebuilt = build(functions(), cache, rebuild=True)
    assert [report.from_cache for report in rebuilt.reports] == [False, False]


def test_what_the_key_depends_on(cache: Cache, monkeypatch: pytest.MonkeyPatch) -> None:
    x = ca.MX.sym("x", 4)
    keys = [build(functions(), cache).keys["square"]]
    other = ca.Function("square", [x], [x**2 + 1.0], ["x"], ["y"])
    keys.append(build({"square": other}, cache).keys["square"])
    keys.append(build(functions(), cache, levels={"square": 1}).keys["square"])
    monkeypatch.setenv("CC", "gcc -g0")
    keys.append(build(functions(), cache).keys["square"])
    assert len(set(keys)) == len(keys)


@pytest.mark.parametrize("damage", [b"", b"not a library", None])
def test_damaged_library_is_built_anew(cache: Cache, damage: bytes | None) -> None:
    function = compile_function(functions()["square"], cache)
    assert isinstance(function, CompiledFunction)
    if damage is None:
        content = bytearray(function.library.read_bytes())
        content[len(content) // 2] ^= 1
        damage = bytes(content)
    # As a disk would: another file in its place, for the loaded one is mapped into this process.
    replacement = function.library.with_suffix(".damaged")
    replacement.write_bytes(damage)
    replacement.replace(function.library)
    again = build({"square": functions()["square"]}, cache)
    assert not again.reports[0].from_cache
    np.testing.assert_array_equal(
        again.functions["square"](np.arange(4.0))["y"], np.arange(4.0) ** 2
    )


def test_intact_library_that_cannot_be_loaded_is_built_anew(cache: Cache) -> None:
    key = build(functions(), cache).keys["square"]

    def make(path: Path) -> dict[str, object]:
        path.write_bytes(b"\x7fELF of another system")
        record = cache.read_record(key)
        assert record is not None
        return record

    cache.store(key, make)
    again = build(functions(), cache)
    assert [report.from_cache for report in again.reports] == [False, True]
    assert again.functions["square"](np.full(4, 3.0))["y"][0] == 9.0


def test_warm_start_needs_neither_graph_nor_casadi(cache: Cache) -> None:
    cold = load_or_build("cell", functions, cache)
    program = """
import sys
from codegen.build import load_or_build
def make():
    raise AssertionError("made again")
found = load_or_build("cell", make)
assert "casadi" not in sys.modules
print(found["norm"]([3.0, 4.0, 0.0, 0.0])["y"], *found)
"""
    done = run(program)
    assert done.stderr == ""
    assert done.stdout == "5.0 square norm\n"
    assert cold["norm"].signature == load_or_build("cell", functions, cache)["norm"].signature


def test_set_with_a_lost_member_is_made_anew(cache: Cache) -> None:
    key = build(functions(), cache, key="cell").keys["norm"]
    for path in cache.folder.glob(f"{key}*"):
        path.unlink()
    found = load_or_build("cell", functions, cache)
    assert found["norm"]([3.0, 4.0, 0.0, 0.0])["y"] == 5.0


def test_two_processes_at_once_build_once(cache: Cache, tmp_path: Path) -> None:
    log = tmp_path / "log"
    compiler = tmp_path / "counting-cc"
    compiler.write_text(
        f'#!/bin/sh\ncase "$*" in -v|*" -E "*) ;; *) echo "$*" >> "{log}"; sleep 0.3 ;; esac\n'
        'exec gcc "$@"\n'
    )
    compiler.chmod(0o755)
    program = (
        SET + "from codegen.build import load_or_build\n"
        "found = load_or_build('cell', lambda: functions)\n"
        "print(found['square']([1.0, 2.0, 3.0, 4.0])['y'].tolist())\n"
    )
    environment = os.environ | {"CC": str(compiler)}
    running = [
        subprocess.Popen(
            [sys.executable, "-c", program], env=environment, stdout=subprocess.PIPE, text=True
        )
        for _ in range(2)
    ]
    for process in running:
        assert process.communicate(timeout=HANGS)[0] == "[1.0, 4.0, 9.0, 16.0]\n"
    assert len(log.read_text().splitlines()) == 2  # one per function, not per process


def test_killed_build_leaves_the_cache_usable(
    cache: Cache, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started, go_on = tmp_path / "started", tmp_path / "go_on"
    compiler = tmp_path / "slow-cc"
    compiler.write_text(
        '#!/bin/sh\ncase "$*" in -v|*" -E "*) exec gcc "$@" ;; esac\n'
        f'gcc "$@"\ntouch "{started}"\n'
        f'while [ ! -e "{go_on}" ]; do sleep 0.05; done\n'
    )
    compiler.chmod(0o755)
    monkeypatch.setenv("CC", str(compiler))
    program = (
        SET + "from codegen.build import load_or_build\nload_or_build('cell', lambda: functions)"
    )
    process = subprocess.Popen([sys.executable, "-c", program], start_new_session=True)
    until(started.exists, process)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert list(cache.folder.glob("*.so")) == []
    go_on.touch()
    found = load_or_build("cell", functions, cache)
    assert found["norm"]([3.0, 4.0, 0.0, 0.0])["y"] == 5.0


def test_without_a_compiler_nothing_is_made(cache: Cache, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse() -> dict[str, ca.Function]:
        raise AssertionError("made before the compiler was looked for")

    monkeypatch.setenv("CC", "/missing/cc")
    with pytest.raises(CodegenError, match=r"no C compiler .*CC names '/missing/cc'"):
        load_or_build("cell", refuse, cache)
    with pytest.raises(CodegenError, match="apt install"):
        compile_function(functions()["norm"], cache)
    assert not cache.folder.exists()


def test_compilers_are_tried_in_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CC", raising=False)
    broken = tmp_path / "cc"
    broken.write_text("#!/bin/sh\nexit 1\n")
    broken.chmod(0o755)
    gcc = shutil.which("gcc")
    assert gcc is not None
    (tmp_path / "gcc").symlink_to(gcc)
    monkeypatch.setenv("PATH", f"{tmp_path}:/bin:/usr/bin")
    assert find_compiler().command == (str(tmp_path / "gcc"),)
    monkeypatch.setenv("PATH", "")
    monkeypatch.setattr(compiler, "PACKAGED", "a_package_that_is_not_there")
    compiler._find.cache_clear()
    for cc in ("", "   "):
        monkeypatch.setenv("CC", cc)
        with pytest.raises(CodegenError, match=r"no C compiler .* cc, gcc, clang and the package"):
            find_compiler()


def test_a_compiler_that_is_a_package_is_found_last(
    cache: Cache, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A package as `ziglang` is one, which runs the system's compiler here."""
    gcc = shutil.which("gcc")
    (tmp_path / "packaged_cc").mkdir()
    (tmp_path / "packaged_cc" / "__init__.py").touch()
    run = f"import os, sys\nos.environ['PATH'] = '/usr/bin:/bin'\nos.execv({gcc!r}, sys.argv[1:])\n"
    (tmp_path / "packaged_cc" / "__main__.py").write_text(run)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(compiler, "PACKAGED", "packaged_cc")
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setenv("PATH", "")
    compiler._find.cache_clear()
    assert find_compiler().command == (sys.executable, "-m", "packaged_cc", "cc")
    compiled = compile_function(functions()["norm"], cache)
    np.testing.assert_allclose(compiled(np.full(4, 1.5))["y"], 3.0)
    compiler._find.cache_clear()


def test_compiler_that_fails_is_told(
    cache: Cache, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compiler = tmp_path / "full-cc"
    compiler.write_text(
        '#!/bin/sh\ncase "$*" in -v|*" -E "*) exec gcc "$@" ;; esac\n'
        'echo "cc1: fatal error: No space left on device" >&2\nexit 1\n'
    )
    compiler.chmod(0o755)
    monkeypatch.setenv("CC", str(compiler))
    with pytest.raises(CodegenError, match=r"square\.c: cc1: .*No space left on device; ") as told:
        build({"square": functions()["square"]}, cache)
    assert "\n" not in str(told.value)
    assert list(cache.folder.glob("*.so")) == []


def test_function_that_cannot_be_written_as_c_is_told(
    cache: Cache, capfd: pytest.CaptureFixture[str]
) -> None:
    class Doubled(ca.Callback):  # type: ignore[misc]
        def __init__(self) -> None:
            ca.Callback.__init__(self)
            self.construct("doubled", {})

        def eval(self, arguments: list[ca.DM]) -> list[ca.DM]:
            return [2.0 * arguments[0]]

    doubled = Doubled()
    x = ca.MX.sym("x")
    with pytest.raises(CodegenError, match="uses_python"):
        compile_function(ca.Function("uses_python", [x], [doubled(x)]), cache)
    capfd.readouterr()


def test_libraries_are_kept_apart_by_instruction_set(
    cache: Cache, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = 'case "$*" in *" -E "*) echo "#define __OTHER__ 1" ;; *) exec gcc "$@" ;; esac'
    ignorant = 'case "$*" in *native*) exit 1 ;; *) exec gcc "$@" ;; esac'
    found = []
    for k, script in enumerate(('exec gcc "$@"', other, ignorant)):
        compiler = tmp_path / f"cc-{k}"
        compiler.write_text(f"#!/bin/sh\n{script}\n")
        compiler.chmod(0o755)
        monkeypatch.setenv("CC", str(compiler))
        assert build(functions(), cache).functions["norm"]([3.0, 4.0, 0.0, 0.0])["y"] == 5.0
        found.append(find_compiler())
    own, of_another, without = found
    assert len(own.machine) == 1
    assert own.machine == of_another.machine
    assert of_another.instructions == "#define __OTHER__ 1\n" != own.instructions
    assert without.machine == ()
    assert replace(own, instructions=of_another.instructions).identity != own.identity
