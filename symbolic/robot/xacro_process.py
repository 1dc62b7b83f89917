"""The process in which a xacro file is expanded: `python -m symbolic.robot.xacro_process`.

xacro evaluates Python expressions and calls macros as often as the file likes, so this happens in
a process of its own, with so much time and memory and no more, that writes no file and starts
nothing. `symbolic.robot.xacro_file` starts it: a request comes in as JSON, an answer goes out.
"""

from __future__ import annotations

import errno
import io
import json
import os
import resource
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from symbolic import outside
from symbolic.errors import OutsideError
from symbolic.robot.packages import PACKAGE_SCHEME, find_package

CPU_SECONDS = 5
"""So long an expansion may compute."""

MEMORY_BYTES = 192 * outside.MEBIBYTE
MEMORY_PER_BYTE = 6
"""So much memory it may take, and so much more per byte of the file."""

ANSWER_BYTES = 8 * outside.URDF_BYTES
"""Largest answer; JSON may take six bytes for a letter."""

_REFUSED = ("os.", "subprocess.", "socket.", "shutil.", "ctypes.", "resource.", "signal.", "pty.")
_LOOKING = ("os.listdir", "os.scandir", "os.walk")
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC


def main() -> int:
    """Answer the request on standard input; the exit code."""
    request = json.load(sys.stdin)
    path = Path(request["path"])
    answer, sys.stdout = sys.stdout, io.StringIO()
    import xacro
    import xacro.substitution_args  # their own files are read before the limits

    _limit(os.stat(path).st_size)
    try:
        found = _expanded(xacro, path, request["arguments"], request["package_dirs"])
    except Exception as error:  # a macro may raise anything
        found = {"refused": _told(error, xacro)}
    json.dump(found, answer)
    answer.flush()
    return 0


def _limit(size: int) -> None:
    """Bound what is left of this process's life."""
    for kind, most in (
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_CPU, CPU_SECONDS),
        (resource.RLIMIT_FSIZE, ANSWER_BYTES),
        (resource.RLIMIT_AS, MEMORY_BYTES + MEMORY_PER_BYTE * size),
    ):
        _, hard = resource.getrlimit(kind)
        most = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(kind, (most, most))
    sys.addaudithook(_refuse_deeds)


def _refuse_deeds(event: str, arguments: tuple[Any, ...]) -> None:
    """An expansion reads files; whatever else its expressions find a way to is refused."""
    writes = event == "open" and isinstance(arguments[2], int) and arguments[2] & _WRITING
    if writes or (event.startswith(_REFUSED) and event not in _LOOKING):
        raise OutsideError(f"holds an expression that does more than compute ({event})")


def _expanded(
    xacro: Any, path: Path, arguments: Mapping[str, str], package_dirs: list[str]
) -> dict[str, Any]:
    """The expanded text, and the paths of the files that were included."""
    found: dict[str, Path] = {}

    def find(name: str) -> str:
        package = find_package(name, [Path(folder) for folder in package_dirs], path)
        if package is None:
            raise OutsideError(
                f"names the package {name!r}, which is not found; name the folder that holds it "
                "in package_dirs, or set ROS_PACKAGE_PATH or AMENT_PREFIX_PATH"
            )
        found[name] = package
        return str(package)

    xacro.substitution_args._eval_find = find
    xacro.open = _opened  # stands before Python's own in that module
    document = xacro.process_file(str(path), mappings=dict(arguments))
    for mesh in document.getElementsByTagName("mesh"):
        mesh.setAttribute("filename", _by_package(mesh.getAttribute("filename"), found))
    # What stands beside the root are comments that name this machine's folders.
    text = document.documentElement.toxml()
    if len(text) > outside.URDF_BYTES:
        raise OutsideError(
            f"expands to more than {outside.megabytes(outside.URDF_BYTES)}; allowed is so much"
        )
    return {"urdf": text, "included": list(dict.fromkeys(map(str, xacro.all_includes)))}


def _opened(name: str) -> io.StringIO:
    """An included file, through the door; what is missing may be optional."""
    if not os.path.exists(name):
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), name)
    try:
        return io.StringIO(outside.text(outside.read_bytes(Path(name), outside.URDF_BYTES)))
    except OutsideError as error:
        raise OutsideError(f"includes {Path(name).name}, which {error}") from error


def _by_package(address: str, packages: Mapping[str, Path]) -> str:
    """A mesh address without this machine's folders, as far as they are those of packages."""
    for name, folder in packages.items():
        start = f"{folder}/"
        if address.removeprefix("file://").startswith(start):
            return f"{PACKAGE_SCHEME}{name}/{address.removeprefix('file://').removeprefix(start)}"
    return address


def _told(error: BaseException, xacro: Any) -> str:
    """What went wrong, and in which file and macro."""
    causes = tuple(_causes(error))
    own = next((cause for cause in causes if isinstance(cause, OutsideError)), None)
    if own is not None:
        return str(own)
    place = _place(xacro)
    if any(isinstance(cause, MemoryError) for cause in causes):
        return f"needs too much memory to be expanded{place}; simplify its expressions and macros"
    if any(isinstance(cause, RecursionError) for cause in causes):
        return (
            f"is nested too deeply to be expanded{place}; does a macro call or a file include "
            "itself?"
        )
    reason = " ".join(str(error).split()) or type(error).__name__
    return f"holds xacro macros that cannot be expanded: {reason[:300]}{place}"


def _causes(error: BaseException) -> Iterator[BaseException]:
    """An error and those that it was made of."""
    left, met = [error], set[int]()
    while left:
        one = left.pop()
        if id(one) not in met:
            met.add(id(one))
            yield one
            inner = (getattr(one, "exc", None), one.__cause__, one.__context__)
            left += [cause for cause in inner if isinstance(cause, BaseException)]


def _place(xacro: Any) -> str:
    files = [Path(file).name for file in xacro.filestack or () if file is not None]
    macros = [macro.body.getAttribute("name") for macro in xacro.macrostack or ()]
    where = [f"file {files[-1]}"] if len(files) > 1 else []
    where += [f"macro {macros[-1]}"] if macros else []
    return f" ({', '.join(where)})" if where else ""


if __name__ == "__main__":
    sys.exit(main())
