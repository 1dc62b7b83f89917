"""Robot descriptions written as xacro macros, expanded to the URDF they stand for.

xacro itself does it. The package `xacrodoc`, which wraps it, was looked at and left: it keeps one
list of packages per process, and loses the folder that relative includes are relative to.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from threading import Lock

from symbolic import outside
from symbolic.errors import OutsideError
from symbolic.robot.packages import PACKAGE_SCHEME, find_package

XACRO_NAMESPACE = b"http://www.ros.org/wiki/xacro"
_MACRO = re.compile(rb"<xacro:|\$\{|\$\(")
_LOCK = Lock()

Arguments = tuple[tuple[str, str], ...]


def description_content(
    path: Path, arguments: Arguments = (), package_dirs: Sequence[Path] = ()
) -> bytes:
    """The URDF text of a robot's description: the file's own, or what its macros expand to.

    Args:
        path: a URDF, or a xacro file.
        arguments: values of the xacro file's arguments, by name; a plain URDF takes none.
        package_dirs: folders of packages that `$(find NAME)` looks in first.

    Raises:
        OutsideError: it cannot be read or expanded.
    """
    content = outside.read_bytes(path, outside.URDF_BYTES)
    if not is_xacro(content):
        return content
    key = (path, content, arguments, tuple(package_dirs))
    expanded, parts = _expanded(*key)
    if parts != _state(path for path, _ in parts):  # an included file has changed since
        _expanded.cache_clear()
        expanded, _ = _expanded(*key)
    return expanded


def is_xacro(content: bytes) -> bool:
    """Whether a description holds macros to be expanded; generated URDFs often keep the name."""
    return XACRO_NAMESPACE in content and _MACRO.search(content) is not None


@lru_cache(maxsize=8)
def _expanded(
    path: Path, content: bytes, arguments: Arguments, package_dirs: tuple[Path, ...]
) -> tuple[bytes, tuple[tuple[str, bytes], ...]]:
    """The expanded text, and path and digest of every file that was included."""
    # Not imported at the top: most descriptions need no xacro.
    import xacro
    from xacro import substitution_args

    found: dict[str, Path] = {}

    def find(name: str) -> str:
        package = find_package(name, package_dirs, path)
        if package is None:
            raise OutsideError(
                f"names the package {name!r}, which is not found; name the folder that holds it "
                "in package_dirs, or set ROS_PACKAGE_PATH or AMENT_PREFIX_PATH"
            )
        found[name] = package
        return str(package)

    with _LOCK, contextlib.redirect_stderr(io.StringIO()):  # xacro keeps its state in its module
        theirs, their_parse = substitution_args._eval_find, xacro.parse
        substitution_args._eval_find = find

        def parse(text: object, filename: str | None = None) -> object:
            # Included files come through our door; a missing one may be optional.
            if text is None and filename is not None and os.path.exists(filename):
                text = outside.text(outside.read_bytes(Path(filename), outside.URDF_BYTES))
            return their_parse(text, filename)

        xacro.parse = parse
        xacro.all_includes.clear()
        try:
            document = xacro.process_file(str(path), mappings=dict(arguments))
            included = tuple(dict.fromkeys(map(str, xacro.all_includes)))
        except OutsideError:
            raise
        except Exception as error:  # a macro may raise anything
            reason = " ".join(str(error).split()) or type(error).__name__
            raise OutsideError(f"holds xacro macros that cannot be expanded: {reason[:300]}") from (
                error
            )
        finally:
            substitution_args._eval_find, xacro.parse = theirs, their_parse
    for mesh in document.getElementsByTagName("mesh"):
        mesh.setAttribute("filename", _by_package(mesh.getAttribute("filename"), found))
    # What stands beside the root are comments that name this machine's folders.
    return document.documentElement.toxml().encode(), _state(included)


def _by_package(address: str, packages: Mapping[str, Path]) -> str:
    """A mesh address without this machine's folders, as far as they are those of packages."""
    for name, folder in packages.items():
        start = f"{folder}/"
        if address.removeprefix("file://").startswith(start):
            return f"{PACKAGE_SCHEME}{name}/{address.removeprefix('file://').removeprefix(start)}"
    return address


def _state(paths: Iterable[str]) -> tuple[tuple[str, bytes], ...]:
    """Each file with the digest of its content."""
    return tuple(
        (path, hashlib.sha256(outside.read_bytes(Path(path), outside.URDF_BYTES)).digest())
        for path in paths
    )
