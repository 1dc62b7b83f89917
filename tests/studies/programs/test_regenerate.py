"""`python -m studies.regenerate` on a tiny cell: what it prints, what it refuses, how it ends."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
import pytest

from codegen import source
from codegen.build import compiler_of
from codegen.cache import Cache
from studies.regenerate import main
from symbolic.errors import WorkcellError
from tests.refusals import ended_by

Run = Callable[..., tuple[int, str, str]]


class TinyCell:
    """In place of a `CompiledCell`."""

    symbols = SimpleNamespace(screening={})

    def __init__(self, workcell: object, cache: Cache) -> None:
        compiler_of(cache)
        self.workcell = workcell

    def key(self, name: str, bodies: bool = True) -> str:
        return f"{name} of a tiny cell"

    def vector(self, name: str) -> np.ndarray:
        return np.zeros(0)


def tiny(path: Path) -> Any:
    if path.name != "cell.toml":
        raise WorkcellError(str(path), ("file: missing; name a workcell",))
    return SimpleNamespace(task=SimpleNamespace(lower=np.full(3, 2.0), upper=np.full(3, 5.0)))


def functions(_: object) -> dict[str, ca.Function]:
    x, p = ca.MX.sym("x", 3), ca.MX.sym("p", 2, 2)
    # NaN outside the bounds of x.
    return {"roots": ca.Function("roots", [x, p], [ca.sqrt(x - 2), p @ p], ["x", "p"], ["y", "z"])}


@pytest.fixture
def run(
    cache: Cache,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> Run:
    """The program with a cell of one function in place of the file's; code, output and messages."""
    monkeypatch.chdir(tmp_path)
    for name in ("cell.toml", "other.toml"):
        (tmp_path / name).touch()
    monkeypatch.setattr("studies.programs.regeneration.CompiledCell", TinyCell)
    monkeypatch.setattr("symbolic.read.cell.load", tiny)
    monkeypatch.setattr("symbolic.functions.arm_functions", functions)

    def ended(*arguments: str) -> tuple[int, str, str]:
        code = main(arguments)
        return code, *capsys.readouterr()

    return ended


def test_functions_are_made_kept_made_anew_and_removed(run: Run, cache: Cache) -> None:
    code, first, _ = run("cell.toml")
    assert code == 0
    headings, rule, row = first.splitlines()
    for heading in ("function", "operations", "C size", "compile time", "from cache"):
        assert heading in headings
    assert set(rule) == {"-"}
    assert row.startswith("roots")
    assert row.endswith(" no")
    assert "kB" in row
    assert run("cell.toml")[1].splitlines()[2].endswith(" yes")
    code, said, _ = run("cell.toml", "--check", "--json", "--samples", "5")
    assert code == 0
    result = json.loads(said)
    assert result["cache"] == str(cache.folder)
    (function,) = result["functions"]
    assert function["name"] == "roots"
    assert min(function[name] for name in ("operations", "c_bytes", "compile_seconds")) > 0
    assert function["from_cache"] is False
    (check,) = result["check"]
    assert (check["agrees"], check["samples"]) == (True, 5)
    assert max(check["outputs"], check["derivatives"]) <= 1e-10
    kept = len(list(cache.folder.glob("*.so")))
    assert kept > 0
    code, said, _ = run("--clean")
    assert code == 0
    assert said.startswith(f"{kept} ")
    assert str(cache.folder) in said
    assert list(cache.folder.iterdir()) == []
    assert json.loads(run("cell.toml", "--clean", "--json")[1])["removed"] == 0


def test_check_finds_a_difference(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """A compiler that rounds differently by one part in 1e9 is caught, with the output's name."""
    plain = source.c_source

    def rounded(*given: Any) -> str:
        return re.sub(r"\bsqrt\(", "1.000000001 * sqrt(", plain(*given))

    monkeypatch.setattr(source, "c_source", rounded)
    code, said, _ = run("cell.toml", "--check")
    assert code == 1
    assert "NO: " in said


def test_what_the_cache_holds_is_said(run: Run, cache: Cache) -> None:
    cache.write_record("0" * 64, {"kept": True})
    size = (cache.folder / f"{'0' * 64}.json").stat().st_size
    usage = json.loads(run("--cache", "--json")[1])["usage"]
    assert usage == {"libraries": 0, "files": 1, "size": size}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "--clean"),
        (["cell.toml", "--samples", "0"], "--samples: found '0'"),
        (["cell.toml", "--seed", "-1"], "--seed: found '-1'"),
        (["other.toml"], "file: missing"),
        (["cell.toml"], "'/missing/cc'"),
    ],
)
def test_bad_input_is_one_message_and_nothing_is_begun(
    run: Run,
    cache: Cache,
    arguments: list[str],
    message: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("CC", "/missing/cc")
    try:
        code, said, told = run(*arguments)
    except SystemExit as end:
        code, (said, told) = int(end.code or 0), capsys.readouterr()
    assert (code, said) == (2, "")
    assert message in told
    assert not cache.folder.exists()


@pytest.mark.parametrize("study", [[], ["--study"]])
@pytest.mark.parametrize("wrong", ["file", "model", "limit", "compiler"])
def test_nothing_is_removed_before_all_is_checked(
    run: Run, cache: Cache, wrong: str, study: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    cache.write_record("0" * 64, {"kept": True})
    before = sorted(cache.folder.iterdir())
    if wrong == "model":

        def refused(_: object) -> None:
            raise WorkcellError("cell.toml", ("robots: cannot be modelled",))

        monkeypatch.setattr("symbolic.functions.arm_functions", refused)
    if wrong == "limit":
        monkeypatch.setenv("DUAL_ARM_CACHE_LIMIT", "much")
    if wrong == "compiler":
        monkeypatch.setenv("CC", "/missing/cc")
    file = "other.toml" if wrong == "file" else "cell.toml"
    code, _, told = run(file, "--clean", *study)
    assert (code, sorted(cache.folder.iterdir())) == (2, before), told


def test_a_cache_that_others_can_write_to_is_refused(run: Run, cache: Cache) -> None:
    cache.folder.mkdir()
    cache.folder.chmod(0o777)
    with ended_by("writable-by-others", "chmod go-w"):
        code, _, told = run("cell.toml")
    assert code == 2
    assert len(told.splitlines()) == 1
