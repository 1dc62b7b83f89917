"""Robots by name: descriptions that Python packages hold or download.

A name that ends in `_description` is a module of the package `robot_descriptions`, which clones the
repository with the files when it is first asked for. Any other is a file of `example-robot-data`,
whose wheel holds the files themselves.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Collection, Iterator
from contextlib import redirect_stdout
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

from symbolic.errors import OutsideError
from symbolic.read.descriptions import Arguments, find_package
from symbolic.records.problems import suggestion

MODULES = "robot_descriptions"
FILES = "example-robot-data"

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,99}")
_KEY = re.compile(r"""(?<![\w.-])robot(\s*=\s*)(["'])([\w-]+)\2""")


@dataclass(frozen=True)
class NamedRobot:
    """A description on this machine.

    Attributes:
        path: the URDF or xacro file.
        arguments: of the xacro file.
        package_dirs: folders that hold the packages that it names.
    """

    path: Path
    arguments: Arguments
    package_dirs: tuple[Path, ...]


def named_robot(name: str) -> NamedRobot:
    """The description of a name, downloaded where it is not there yet.

    Raises:
        OutsideError: none has that name, a package is missing, or the download failed.
    """
    if not _NAME.fullmatch(name):
        raise OutsideError("is no name; allowed are letters, digits, '_' and '-'")
    return _downloaded(name) if name.endswith("_description") else _installed(name)


def _installed(name: str) -> NamedRobot:
    folder = find_package(FILES, (), Path("/"))
    if folder is None:
        raise OutsideError(
            f"is looked for in a package that is missing: pip install {FILES}; names that end in "
            f"_description are those of {MODULES}"
        )
    known = {path.stem: path for path in sorted((folder / "robots").rglob("*.urdf"))}
    path = known.get(name) or known.get(f"{name}_robot")
    if path is None:
        meant = suggestion(name, known) or f"; {FILES} has {', '.join(known)}"
        raise OutsideError(f"is the name of no description{meant}")
    return NamedRobot(path, (), (folder.parent,))


def _downloaded(name: str) -> NamedRobot:
    if find_spec(MODULES) is None:
        raise OutsideError(
            f'is looked for in a package that is missing: pip install "dual-arm-carry[robots]" '
            f"({MODULES})"
        )
    if find_spec(f"{MODULES}.{name}") is None:
        raise OutsideError(
            f"is the name of no description of {MODULES}{suggestion(name, _modules())}; "
            f"python -m {MODULES} list shows all"
        )
    try:
        with redirect_stdout(sys.stderr):  # it tells what it clones
            module = import_module(f"{MODULES}.{name}")
    except Exception as error:  # of git, of the network, of the file system
        reason = " ".join(str(error).split())[-300:]
        raise OutsideError(
            f"cannot be downloaded; is the network reachable, and git installed? ({reason})"
        ) from error
    path = getattr(module, "URDF_PATH", None)
    arguments = {} if path else getattr(module, "XACRO_ARGS", {})
    path = path or getattr(module, "XACRO_PATH", None)
    path = path or getattr(module, "MJCF_PATH", None)
    if path is None:
        raise OutsideError("has neither URDF nor MJCF; name a description that has")
    package, repository = Path(module.PACKAGE_PATH), Path(module.REPOSITORY_PATH)
    folders = dict.fromkeys((package.parent, repository, repository.parent))
    named = tuple((str(key), str(value)) for key, value in arguments.items())
    return NamedRobot(Path(path), named, tuple(folders))


def _modules() -> Iterator[str]:
    """Names of all descriptions of the package."""
    folder = Path(str(find_spec(MODULES).origin)).parent  # type: ignore[union-attr]
    return (path.stem for path in sorted(folder.glob("*_description.py")))


def with_paths(text: str, names: Collection[str]) -> str:
    """A workcell file's text with these robots' names replaced by the paths of their descriptions.

    Raises:
        OutsideError: see `named_robot`.
    """

    def address(found: re.Match[str]) -> str:
        before, quote, name = found.groups()
        path = named_robot(name).path if name in names else None
        return f"urdf{before}{quote}{path}{quote}" if path else found[0]

    return _KEY.sub(address, text)
