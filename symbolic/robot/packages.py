"""Where the packages are that a robot description names: `package://NAME/...`, `$(find NAME)`.

A package is looked for as ROS does it, but needs no ROS: in the folders that the workcell gives,
among the folders around the description, where ROS's environment variables point, and beside the
installed Python packages.
"""

from __future__ import annotations

import os
import re
import site
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

PACKAGE_SCHEME = "package://"
DEEPEST_PACKAGE = 4
"""How far below a folder of ROS_PACKAGE_PATH a package may lie."""

LONGEST_NAME = 200

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")
_SKIPPED = ("build", "devel", "install", "log")


def find_package(name: str, package_dirs: Sequence[Path], description: Path) -> Path | None:
    """The folder of a package, or None where there is none.

    In this order: NAME in one of `package_dirs`; a folder NAME above the description;
    `share/NAME` below each prefix of AMENT_PREFIX_PATH; NAME in or at most `DEEPEST_PACKAGE`
    levels below a folder of ROS_PACKAGE_PATH; `share/NAME` of the Python environment and of the
    prefix that wheels of robotics libraries share in it (`cmeel.prefix`).

    Args:
        name: the package.
        package_dirs: the folders that a workcell names.
        description: the file that names the package.
    """
    if len(name) > LONGEST_NAME or not _NAME.fullmatch(name):
        return None
    for folder in package_dirs:
        if os.path.isdir(folder / name):
            return folder / name
    for parent in description.resolve().parents:
        if parent.name == name:
            return parent
    for prefix in _paths("AMENT_PREFIX_PATH"):
        if (prefix / "share" / name).is_dir():
            return prefix / "share" / name
    for folder in _paths("ROS_PACKAGE_PATH"):
        found = _below(folder, name, DEEPEST_PACKAGE)
        if found is not None:
            return found
    installed = (prefix / "share" / name for prefix in _environment_prefixes())
    return next((folder for folder in installed if folder.is_dir()), None)


def further_package_dirs(
    addresses: Iterable[str], package_dirs: Sequence[Path], description: Path
) -> tuple[Path, ...]:
    """Folders besides `package_dirs` that hold the packages of mesh addresses, each once.

    A package that a given folder already holds is left out, and one that is nowhere.
    """
    names = dict.fromkeys(
        address.removeprefix(PACKAGE_SCHEME).split("/", 1)[0]
        for address in addresses
        if address.startswith(PACKAGE_SCHEME)
    )
    found = (find_package(name, package_dirs, description) for name in names)
    folders = dict.fromkeys(package.resolve().parent for package in found if package is not None)
    return tuple(folder for folder in folders if folder not in package_dirs)


def _paths(variable: str) -> Iterator[Path]:
    return (Path(entry) for entry in os.environ.get(variable, "").split(os.pathsep) if entry)


def _below(folder: Path, name: str, levels: int) -> Path | None:
    """A folder of that name with a package.xml, in a folder or below it."""
    if folder.name == name and (folder / "package.xml").is_file():
        return folder
    try:
        inner = sorted(entry for entry in folder.iterdir() if entry.is_dir())
    except OSError:
        return None
    if levels == 0 or (folder / "package.xml").is_file():  # packages do not hold packages
        return None
    searched = (
        _below(entry, name, levels - 1)
        for entry in inner
        if not entry.name.startswith(".") and entry.name not in _SKIPPED
    )
    return next((found for found in searched if found is not None), None)


def _environment_prefixes() -> Iterator[Path]:
    yield Path(sys.prefix)
    for folder in (*site.getsitepackages(), *sys.path):
        if folder:
            yield Path(folder) / "cmeel.prefix"
