"""What holds for every module: no circle of imports."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("symbolic", "codegen", "hybrid_opt", "studies")


def modules(*packages: str) -> list[Path]:
    return sorted(path for package in packages for path in (ROOT / package).rglob("*.py"))


def named(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


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
