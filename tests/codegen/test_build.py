"""Builds: found in the cache, made anew where damaged, parts compiled once, C by hand; Ctrl-C."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from codegen import compiler, parts
from codegen.build import build, compile_function, load_or_build, load_or_compile
from codegen.cache import Cache
from codegen.compiler import find_compiler
from codegen.errors import CodegenError
from codegen.function import Signature
from codegen.native import CompiledFunction
from codegen.parts import PIECE, in_parts, in_pieces
from codegen.source import c_source, dense, generated_c, handwritten_source
from tests.codegen.samples import ASKED, odd_compiler, square
from tests.refusals import refused
from tests.waiting import HANGS, soon, until


def functions() -> dict[str, ca.Function]:
    x = ca.MX.sym("x", 4)
    return {
        "square": ca.Function("square", [x], [x**2], ["x"], ["y"]),
        "norm": ca.Function("norm", [x], [ca.norm_2(x)], ["x"], ["y"]),
    }


SET = """
from codegen.build import build, load_or_build
from tests.codegen.test_build import functions
found = load_or_build("cell", functions)
"""
"""A program that builds or loads them."""


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


def test_damaged_library_is_built_anew(cache: Cache) -> None:
    function = compile_function(functions()["square"], cache)
    assert isinstance(function, CompiledFunction)
    content = bytearray(function.library.read_bytes())
    content[len(content) // 2] ^= 1
    # As a disk would: another file in its place, for the loaded one is mapped into this process.
    replacement = function.library.with_suffix(".damaged")
    replacement.write_bytes(content)
    replacement.replace(function.library)
    again = build({"square": functions()["square"]}, cache)
    assert not again.reports[0].from_cache
    np.testing.assert_array_equal(
        again.functions["square"](np.arange(4.0))["y"], np.arange(4.0) ** 2
    )


def test_intact_library_that_cannot_be_loaded_is_built_anew(cache: Cache) -> None:
    key = build(functions(), cache).keys["square"]
    record = cache.read_record(key) or {}

    def make(path: Path) -> dict[str, object]:
        path.write_bytes(b"\x7fELF of another system")
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
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, capture_output=True, text=True, timeout=HANGS, check=False)
    assert done.stderr == ""
    assert done.stdout == "5.0 square norm\n"
    assert cold["norm"].signature == load_or_build("cell", functions, cache)["norm"].signature


def test_set_with_a_lost_member_is_made_anew(cache: Cache) -> None:
    key = build(functions(), cache, key="cell").keys["norm"]
    for path in cache.folder.glob(f"{key}*"):
        path.unlink()
    found = load_or_build("cell", functions, cache)
    assert found["norm"]([3.0, 4.0, 0.0, 0.0])["y"] == 5.0


def test_two_processes_at_once_build_once(
    cache: Cache, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = tmp_path / "log"
    odd_compiler(tmp_path, monkeypatch, f'{ASKED}echo "$*" >> "{log}"\nsleep 0.3\nexec gcc "$@"\n')
    program = SET + "print(found['square']([1.0, 2.0, 3.0, 4.0])['y'].tolist())\n"
    command = [sys.executable, "-c", program]
    running = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    for process in running:
        assert process.communicate(timeout=HANGS)[0] == "[1.0, 4.0, 9.0, 16.0]\n"
    made = re.findall(r"(square|norm)\.c", log.read_text())
    assert sorted(made) == ["norm", "square"]  # one per function, not per process


def test_killed_build_leaves_the_cache_usable(
    cache: Cache, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started, go_on = tmp_path / "started", tmp_path / "go_on"
    waits = f'gcc "$@"\ntouch "{started}"\nwhile [ ! -e "{go_on}" ]; do sleep 0.05; done\n'
    odd_compiler(tmp_path, monkeypatch, ASKED + waits)
    process = subprocess.Popen([sys.executable, "-c", SET], start_new_session=True)
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

    monkeypatch.setenv("CC", "gcc '-O2")
    with refused(CodegenError, "no-command", "gcc '-O2"):
        compile_function(functions()["norm"], cache)
    monkeypatch.setenv("CC", "/missing/cc")
    with refused(CodegenError, "no-compiler", "/missing/cc"):
        load_or_build("cell", refuse, cache)
    with refused(CodegenError, "no-compiler", "apt install"):
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
        with refused(CodegenError, "no-compiler", "cc, gcc, clang"):
            find_compiler()


def test_the_compiler_of_a_package_is_found_last_and_works(
    cache: Cache, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The package `ziglang` itself, with parts at each level in one library."""
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setenv("PATH", "")
    compiler._find.cache_clear()
    found = find_compiler()
    assert found.command == (sys.executable, "-m", "ziglang", "cc", *compiler.ZIG_FLAGS)
    for level in compiler.LEVELS:
        compiled = compile_function(functions()["norm"], cache, level=level)
        assert compiled(np.full(4, 1.5))["y"] == 3.0
    # Without the flag a part at -O0 needs handlers that nobody links.
    bare = replace(found, command=found.command[:-1])
    with refused(CodegenError, "not-loadable", "-O1", "ubsan"):
        bare.self_test(tmp_path)
    monkeypatch.setenv("CC", f"{sys.executable} -m ziglang cc")
    assert find_compiler() == found
    compiler._find.cache_clear()


OUTPUT = 'while [ "$1" != "-o" ]; do shift; done\n'
WRONG = """exec gcc '-Dsqrt(x)=fabs(x)' "$@"\n"""
SMALL = 'case "$*" in *part_*|*whole*) exec gcc "$@" ;; esac\n'
"""Beginning of a compiler that passes its self-test."""
FULL = 'echo "cc1: fatal error: No space left on device" >&2\nexit 1\n'


@pytest.mark.parametrize(
    ("script", "code", "quoted"),
    [
        ("exit 0\n", "no-library", "part_0.c"),
        (OUTPUT + ': > "$2"\n', "no-library", "part_0.c"),
        (OUTPUT + 'echo nonsense > "$2"\n', "not-loadable", "-O0"),
        (OUTPUT + 'cp /bin/ls "$2"\n', "not-loadable", "-O0"),
        (WRONG, "wrong-code", "2470.0"),
        ("kill -9 $$\n", "compiler-failed", "signal 9"),
        ("exit 3\n", "compiler-failed", "part_0.c"),
        (FULL, "compiler-failed", "No space left on device"),
        (SMALL + OUTPUT + 'echo nonsense > "$2"\n', "not-loadable", "square"),
        (f"{SMALL}exit 3\n", "compiler-failed", "square.c"),
    ],
)
def test_a_compiler_that_fails_lies_or_dies_is_told(
    cache: Cache,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    script: str,
    code: str,
    quoted: str,
) -> None:
    odd_compiler(tmp_path, monkeypatch, ASKED + script)
    for _ in range(2):  # nothing of it may be taken for a library the second time
        with refused(CodegenError, code, quoted) as told:
            build(square(), cache)
        assert "\n" not in str(told.value)
    monkeypatch.delenv("CC")
    assert build(square(), cache).functions["square"](3.0)["y"] == 9.0


def test_a_compiler_that_hangs_is_ended(
    cache: Cache, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("codegen.compiler.MOST_SECONDS", 0.5)
    odd_compiler(tmp_path, monkeypatch, f"{ASKED}{SMALL}exec sleep 60\n")
    with soon(), refused(CodegenError, "compiler-hangs", "0.5 s", "square.c"):
        build(square(), cache)


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
    for script in ('exec gcc "$@"', other, ignorant):
        odd_compiler(tmp_path, monkeypatch, f"{script}\n")
        compiler._find.cache_clear()
        assert build(functions(), cache).functions["norm"]([3.0, 4.0, 0.0, 0.0])["y"] == 5.0
        found.append(find_compiler())
    own, of_another, without = found
    assert len(own.machine) == 1
    assert own.machine == of_another.machine
    assert of_another.instructions == "#define __OTHER__ 1\n" != own.instructions
    assert without.machine == ()
    assert replace(own, instructions=of_another.instructions).identity != own.identity


STEPS = 150
"""Of a function that is long enough to be compiled apart."""


def leaf(name: str) -> ca.Function:
    """Scalars only, with everything that parts bring along: roots, angles, choices, signs."""
    x = ca.SX.sym("x", 4)
    values = ca.vertsplit(x)
    for k in range(STEPS):
        chosen = ca.fmax(values[k], ca.fmin(values[-1], 0.3)) + ca.sign(values[-2])
        values.append(ca.sin(chosen) * ca.sqrt(ca.fabs(values[-1])) + values[k // 2] ** 2)
    return ca.Function(name, [x], [ca.vertcat(*values[-4:])])


def caller(name: str, inner: ca.Function) -> ca.Function:
    """Calls that cannot be merged: the second needs what the first gives."""
    x = ca.MX.sym("x", 4)
    return ca.Function(name, [x], [inner(inner(x)) + 1.0])


def long_function(steps: int) -> ca.Function:
    """Statements that use others from far back, so that variables live across pieces."""
    x = ca.SX.sym("x", 4)
    values = [*ca.vertsplit(x), x[0], x[1]]
    for k in range(steps):
        values.append(ca.sin(values[k]) * values[-1] - values[-5] / (1.0 + values[k // 2] ** 2))
    return ca.Function("long_line", [x], [ca.vertcat(*values[-7:]), values[steps // 2]])


CUT, LINE = 500, 150
"""Statements from which on the tests cut, and steps of a function that is longer."""


@pytest.mark.parametrize("cut", [False, True], ids=["parts", "pieces"])
@pytest.mark.parametrize(
    "lanes", [1, 0, *(pytest.param(n, marks=pytest.mark.slow) for n in (2, 4))]
)
def test_parts_and_pieces_give_the_bits_of_the_whole(
    cache: Cache, monkeypatch: pytest.MonkeyPatch, lanes: int, cut: bool
) -> None:
    function = long_function(LINE) if cut else caller("outer", leaf("inner"))
    x = np.random.default_rng(0).normal(size=(11, 4))
    if cut:
        monkeypatch.setattr(parts, "CUT_STATEMENTS", CUT)
        monkeypatch.setattr(parts, "LEAST_ENTRY", 0)
    else:
        _, apart = in_parts(c_source(dense(function), lanes))
        assert len(apart) == (1 if lanes == 1 else 2)
    parted = compile_function(function, cache, level=1, lanes=lanes).batch(x)
    assert cut or len(list(cache.folder.glob("*.o"))) == len(apart)
    for name in ("CUT_STATEMENTS", "LEAST_BYTES", "LEAST_ENTRY"):
        monkeypatch.setattr(parts, name, 10**9)
    whole = compile_function(function, cache, level=1, lanes=lanes).batch(x)
    assert len(list(cache.folder.glob("*.so"))) == 2
    for name, values in whole.items():
        np.testing.assert_array_equal(values.view(np.int64), parted[name].view(np.int64))


def test_what_several_functions_call_is_compiled_once(cache: Cache) -> None:
    # Of equal content under other names, called from texts that number their functions otherwise.
    y = ca.MX.sym("y", 4)
    other = leaf("other")
    more = ca.Function("more", [y], [ca.norm_2(other(other(y))) * other(y)])
    built = build({"first": caller("first", leaf("inner")), "second": more}, cache)
    assert len(list(cache.folder.glob("*.o"))) == 1
    x = np.array([0.1, -0.4, 0.7, 1.3])
    inner = compile_function(leaf("inner"), cache)
    memoise = next(iter(inner(x).values()))
    twice = next(iter(inner(memoise).values()))
    first, second = (next(iter(function(x).values())) for function in built.functions.values())
    np.testing.assert_array_equal(first, twice + 1.0)
    np.testing.assert_allclose(second, np.linalg.norm(twice) * memoise, rtol=1e-14)


def test_a_damaged_object_file_is_made_anew(cache: Cache) -> None:
    build({"first": caller("first", leaf("inner"))}, cache)
    (kept,) = cache.folder.glob("*.o")
    kept.write_bytes(b"damaged")
    built = build({"second": caller("second", leaf("inner"))}, cache)
    assert np.isfinite(next(iter(built.functions["second"](np.ones(4)).values()))).all()


def test_what_calls_others_or_is_short_stays_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    x = ca.MX.sym("x", 3, 3)
    matrices = dense(ca.Function("f", [x], [ca.mtimes(x, x) + 1.0]))
    for least, function in ((0, matrices), (10**9, leaf("inner"))):
        monkeypatch.setattr(parts, "LEAST_BYTES", least)
        text = c_source(function)
        assert in_parts(text) == (text, ())
        assert in_pieces(text) == text


def test_every_statement_stays_in_its_order_and_no_piece_is_longer_than_allowed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(parts, "CUT_STATEMENTS", CUT)
    text = generated_c([dense(long_function(LINE))])
    cut = in_pieces(text)
    bodies = re.findall(
        r"__attribute__\(\(noinline\)\) void \w+\([^)]*\) \{\n(.*?)^\}", cut, re.S | re.M
    )
    assert len(bodies) > 1

    def statements(body: str) -> list[str]:
        lines = re.findall(r"^  (?:a\d+\s*=|if).*$", body, re.M)
        return [line for line in lines if not re.match(r"  a\d+=kept\[", line)]

    (whole,) = re.findall(r"^static int casadi_f0\([^)]*\) \{\n(.*?)^\}", text, re.S | re.M)
    assert [line for body in bodies for line in statements(body)] == statements(whole)
    assert max(len(statements(body)) for body in bodies) == PIECE


TEXT = """
int twice_norm(const double** arg, double** res, long long* iw, double* w, int mem) {
  double length;
  const double* inner_arg[1] = {arg[0]};
  double* inner_res[1] = {&length};
  norm(inner_arg, inner_res, iw, w, mem);
  res[0][0] = 2.0 * length;
  return 0;
}
int twice_norm_work(long long* arg, long long* res, long long* iw, long long* w) {
  *arg = 1; *res = 1; *iw = 0; *w = 0;
  return 0;
}
void twice_norm_incref(void) {}
int twice_norm_checkout(void) { return 0; }
void twice_norm_release(int mem) { (void)mem; }
"""


POINT = ca.SX.sym("x", 3)
NORM = ca.Function("norm", [POINT], [ca.norm_2(POINT)])


def source(text: str = TEXT) -> tuple[Signature, str]:
    signature = Signature("twice_norm", ("x",), ("y",), ((3,),), ((),))
    return signature, handwritten_source(signature, text, [NORM])


def refuse() -> tuple[Signature, str]:
    raise AssertionError("made again")


def test_a_batch_calls_its_helper_and_is_found_again(tmp_path: Path) -> None:
    cache = Cache(tmp_path)
    function = load_or_compile("key", source, cache)
    x = np.random.default_rng(1).normal(size=(50, 3))
    expected = 2.0 * np.linalg.norm(x, axis=1)
    np.testing.assert_allclose(function.batch(x, threads=2)["y"], expected, rtol=1e-15)
    again = load_or_compile("key", refuse, cache)
    np.testing.assert_array_equal(again(x[0])["y"], function(x[0])["y"])
    with pytest.raises(CodegenError, match="twice_norm"):
        load_or_compile("other", lambda: source("no C at all"), cache)


def test_long_helpers_in_pairs_are_compiled_for_two_lanes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(parts, "LEAST_ENTRY", 0)
    monkeypatch.setattr(parts, "LEAST_BYTES", 0)
    signature, _ = source()
    helper = leaf("inner")
    pair = (
        "typedef int called(const lanes_real**, lanes_real**, lanes_int*, lanes_real*);\n"
        "called* volatile kept = in_pairs;\n"
    )
    text = handwritten_source(signature, pair + TEXT, [NORM], {"in_pairs": helper})
    assert {part.text.count("DUAL_ARM_LANES 2\n#") for part in in_parts(text)[1]} >= {0}
    function = load_or_compile("pairs", lambda: (signature, text), Cache(tmp_path))
    assert function(np.ones(3))["y"] == pytest.approx(2.0 * np.sqrt(3.0))


@pytest.mark.parametrize("to_all", [True, False])
def test_ctrl_c_ends_the_compilers_and_keeps_what_is_compiled(
    cache: Cache, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, to_all: bool
) -> None:
    """As a terminal sends it, to the whole group of processes, and to this process alone."""
    left, fast = tmp_path / "left", f'{SMALL}case "$*" in *square*) exec gcc "$@" ;; esac\n'
    odd_compiler(tmp_path, monkeypatch, f'{ASKED}{fast}echo $$ > "{left}"\nsleep 600\n')
    program = """
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)
from codegen.build import build, load_or_build
from tests.codegen.test_build import functions
one = {"square": functions()["square"]}
build(one)
try:
    load_or_build("cell", functions)
except KeyboardInterrupt:
    print("interrupted")
print(build(one, rebuild=True).reports[0].from_cache)
"""
    process = subprocess.Popen(
        [sys.executable, "-c", program],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    until(lambda: left.exists() and bool(left.read_text()), process)
    with soon():  # of the 600 s that the compiler would take
        (os.killpg if to_all else os.kill)(process.pid, signal.SIGINT)
        # Compilers begin again with what is asked for next.
        assert process.communicate(timeout=HANGS) == ("interrupted\nFalse\n", "")
        until(lambda: not is_left(int(left.read_text())))
    assert build({"square": functions()["square"]}, cache).reports[0].from_cache


def is_left(group: int) -> bool:
    """Whether any process of a group is."""
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True
