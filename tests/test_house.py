"""What holds for every module: few parameters, files of readable length, no circle of imports."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("symbolic", "codegen", "hybrid_opt", "studies")

MOST_PARAMETERS = 6
"""Of a function; what needs more takes a record."""

MOST_LINES = 330
"""About 300, with room for what belongs together."""

MOST_TEST_LINES = 335
"""Tests of one module stay in one file."""


def modules(*packages: str) -> list[Path]:
    return sorted(path for package in packages for path in (ROOT / package).rglob("*.py"))


def named(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def parameters(function: ast.FunctionDef | ast.AsyncFunctionDef) -> list[str]:
    given = function.args
    names = [argument.arg for argument in [*given.posonlyargs, *given.args, *given.kwonlyargs]]
    return names[1:] if names[:1] in (["self"], ["cls"]) else names


def test_no_function_has_many_parameters() -> None:
    crowded = [
        f"{named(path)}:{node.lineno} {node.name}"
        for path in modules(*PACKAGES, "tests")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        and len(parameters(node)) > MOST_PARAMETERS
    ]
    assert crowded == []


@pytest.mark.parametrize(
    ("packages", "most"), [(PACKAGES, MOST_LINES), (("tests",), MOST_TEST_LINES)]
)
def test_no_file_is_long(packages: tuple[str, ...], most: int) -> None:
    lengths = {
        named(path): len(path.read_text(encoding="utf-8").splitlines())
        for path in modules(*packages)
    }
    assert {name: length for name, length in lengths.items() if length > most} == {}


def imports(path: Path, known: set[str]) -> Iterator[str]:
    """What a module imports when it is imported itself."""
    waiting: list[ast.stmt] = list(ast.parse(path.read_text(encoding="utf-8")).body)
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in known)
        elif isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                yield inner if inner in known else node.module
        elif isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            waiting += node.orelse
        elif isinstance(node, ast.If | ast.Try | ast.With | ast.ClassDef):
            waiting += node.body


def test_no_import_runs_in_a_circle() -> None:
    """Modules that are imported are imported one after the other: each after all that it needs."""
    paths = {
        named(path).removesuffix(".py").removesuffix("/__init__").replace("/", "."): path
        for path in modules(*PACKAGES, "tests")
    }
    needs = {name: set(imports(path, set(paths))) & set(paths) for name, path in paths.items()}
    while free := {name for name, needed in needs.items() if not needed}:
        needs = {name: needed - free for name, needed in needs.items() if name not in free}
    assert needs == {}
