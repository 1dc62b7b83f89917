"""The generic package names belong to this repository, and only they are shipped."""

from __future__ import annotations

import re
import tomllib
from importlib import import_module
from importlib.resources import files
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = ("symbolic", "codegen", "hybrid_opt", "studies")


@pytest.mark.parametrize("name", [*PACKAGES, "tests", "tests.symbolic"])
def test_package_resolves_inside_this_repository(name: str) -> None:
    origin = import_module(name).__file__
    assert origin is not None
    assert Path(origin).resolve() == ROOT.joinpath(*name.split("."), "__init__.py")


def test_exactly_the_packages_are_shipped() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert set(project["tool"]["scikit-build"]["wheel"]["packages"]) == set(PACKAGES)


@pytest.mark.parametrize("name", PACKAGES)
def test_package_declares_its_types(name: str) -> None:
    assert files(name).joinpath("py.typed").is_file()


@pytest.mark.parametrize("path", ["robots/gofa12.urdf", "workcells/rack.toml"])
def test_studies_carries_its_data(path: str) -> None:
    assert files("studies").joinpath(path).read_text().strip()


def test_build_and_run_time_versions_agree() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    build = set(project["build-system"]["requires"])
    run = set(project["project"]["dependencies"])
    assert {"casadi>=3.8.2,<3.9", "libpinocchio>=4.1,<4.2"} <= build
    assert {"casadi>=3.8.2,<3.9", "pin>=4.1,<4.2"} <= run


def test_messages_name_extras_as_a_user_of_the_wheel_installs_them() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    texts = [path.read_text("utf-8") for name in PACKAGES for path in (ROOT / name).rglob("*.py")]
    named = [found for text in texts for found in re.findall(r"pip install [^\n`]*\[.*?\]", text)]
    extras = [re.search(r"dual-arm-carry\[(\w+)\]", each) for each in named]
    assert len(named) >= 8
    assert all(extras), named
    assert {each[1] for each in extras if each} <= set(project["project"]["optional-dependencies"])
