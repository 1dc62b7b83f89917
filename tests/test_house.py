"""What holds for every module: no circle of imports; the generic package names belong to this
repository, and only they are shipped."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from importlib import import_module
from importlib.resources import files
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

from studies.options import EXTRAS
from tests.waiting import HANGS

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("symbolic", "codegen", "hybrid_opt", "studies")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


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


@pytest.mark.parametrize("name", [*PACKAGES, "tests", "tests.symbolic"])
def test_package_resolves_inside_this_repository(name: str) -> None:
    origin = import_module(name).__file__
    assert origin is not None
    assert Path(origin).resolve() == ROOT.joinpath(*name.split("."), "__init__.py")


def test_exactly_the_packages_are_shipped() -> None:
    there = {path.parent.name for path in ROOT.glob("*/__init__.py")} - {"tests"}
    assert set(PROJECT["tool"]["scikit-build"]["wheel"]["packages"]) == set(PACKAGES) == there


@pytest.mark.parametrize("name", PACKAGES)
def test_package_declares_its_types(name: str) -> None:
    assert files(name).joinpath("py.typed").is_file()


@pytest.mark.parametrize("path", ["robots/gofa12.urdf", "workcells/rack.toml"])
def test_studies_carries_its_data(path: str) -> None:
    assert files("studies").joinpath(path).read_text().strip()


RUN_AS = {"libpinocchio": "pin", "libcoal": "coal"}
"""Packages that bring headers, and those that bring the same libraries to a user."""


def specifiers(listed: list[str]) -> dict[str, SpecifierSet]:
    found = map(Requirement, listed)
    return {RUN_AS.get(each.name, each.name): each.specifier for each in found}


def test_what_is_compiled_against_is_what_runs() -> None:
    """One minor version of each library, at build time, at run time and in the tested set."""
    build = specifiers(PROJECT["build-system"]["requires"])
    run = specifiers(PROJECT["project"]["dependencies"])
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    tested = specifiers([line for line in lines if not line.startswith("#")])
    shared = build.keys() & run.keys()
    assert {"casadi", "pin", "coal"} <= shared
    for name in shared:
        assert build[name] == run[name], name
        (pinned,) = tested[name]
        assert pinned.operator == "=="
        major, minor, *_ = map(int, pinned.version.split("."))
        assert pinned.version in run[name]
        assert f"{major}.{minor + 1}" not in run[name]


def test_messages_name_extras_as_a_user_of_the_wheel_installs_them() -> None:
    texts = [path.read_text("utf-8") for name in PACKAGES for path in (ROOT / name).rglob("*.py")]
    named = [found for text in texts for found in re.findall(r"pip install [^\n`]*\[.*?\]", text)]
    extras = [re.search(r"dual-arm-carry\[\{?(\w+)\}?\]", each) for each in named]
    assert len(named) >= 8
    assert all(extras), named
    known = set(PROJECT["project"]["optional-dependencies"])
    assert {each[1] for each in extras if each} - {"extra"} <= known
    assert set(EXTRAS) <= known


@pytest.mark.parametrize("package", ["symbolic", "codegen"])
@pytest.mark.parametrize("file", ["{}.py", "{}/__init__.py"])
def test_another_projects_package_is_named(tmp_path: Path, package: str, file: str) -> None:
    foreign = tmp_path / file.format(package)
    foreign.parent.mkdir(exist_ok=True)
    foreign.touch()
    for started in ("hybrid_opt", "studies.__main__"):
        done = subprocess.run(
            # Without site-packages, whose editable installs come before every path.
            [sys.executable, "-S", "-c", f"import {started}"],
            cwd=tmp_path,
            env=os.environ | {"PYTHONPATH": f"{tmp_path}:{ROOT}"},
            capture_output=True,
            text=True,
            timeout=HANGS,
        )
        last = done.stderr.splitlines()[-1]
        assert last.startswith("ImportError: dual-arm-carry ")
        assert f"'{package}'" in last
        assert str(foreign) in last


FOUR_WORDS = re.compile(r"[A-Za-z']+(?:,? [a-z']+){3}")


def expected_texts(path: Path) -> Iterator[str]:
    """Texts with which a test compares the message of an error or searches an output."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        expected: list[ast.expr] = []
        if isinstance(node, ast.keyword) and node.arg == "match":
            expected = [node.value]
        elif isinstance(node, ast.Call) and ast.unparse(node.func) in ("refused", "ended_by"):
            expected = node.args
        elif isinstance(node, ast.Compare) and isinstance(node.ops[0], ast.In | ast.NotIn):
            expected = [node.left]
        for value in expected:
            parts = value.values if isinstance(value, ast.JoinedStr) else [value]
            for part in parts:
                if isinstance(part, ast.Constant) and isinstance(part.value, str):
                    yield part.value


def test_tests_expect_codes_keys_and_numbers_in_place_of_sentences() -> None:
    """A sentence may be rewritten without a test."""
    found = {
        f"{named(path)}: {text}"
        for path in modules("tests")
        for text in expected_texts(path)
        if FOUR_WORDS.search(text)
    }
    assert not found


def definitions() -> Iterator[tuple[str, str, str]]:
    """Every class and constant of a module as its name, a text of what it is, and the module.

    Programs that bundles carry along import nothing of this project, so they are left out.
    """
    programs = ROOT / "hybrid_opt" / "extras" / "bundles" / "programs"
    for path in modules(*PACKAGES):
        if path.parent == programs:
            continue
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                yield node.name, f"class of {named(path)}", named(path)
        for node in tree.body:
            if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                for target in targets:
                    if isinstance(target, ast.Name) and target.id.strip("_").isupper():
                        yield target.id, ast.unparse(node.value), named(path)


def test_no_class_and_no_constant_is_defined_twice_with_another_meaning() -> None:
    meanings: dict[str, dict[str, str]] = {}
    for name, meaning, path in definitions():
        meanings.setdefault(name, {})[meaning] = path
    assert not {name: sorted(found.values()) for name, found in meanings.items() if len(found) > 1}
