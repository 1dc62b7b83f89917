"""Robot descriptions written as xacro macros, expanded to the URDF they stand for.

xacro itself does it, in a process of its own that is bounded (`symbolic.robot.xacro_process`). The
package `xacrodoc`, which wraps it, was looked at and left: it keeps one list of packages per
process, and loses the folder that relative includes are relative to.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

from symbolic import outside
from symbolic.errors import OutsideError
from symbolic.robot.xacro_process import CPU_SECONDS

XACRO_NAMESPACE = b"http://www.ros.org/wiki/xacro"
WAIT_SECONDS = 60.0
"""So long an expansion may take, its computing time being bounded more tightly."""

_MACRO = re.compile(rb"<xacro:|\$\{|\$\(")
_PROCESS = "symbolic.robot.xacro_process"

Arguments = tuple[tuple[str, str], ...]
Parts = tuple[tuple[str, bytes], ...]


def description_content(
    path: Path, arguments: Arguments = (), package_dirs: Sequence[Path] = ()
) -> bytes:
    """The URDF text of a robot's description: the file's own, or what its macros expand to.

    Args:
        path: a URDF, or a xacro file.
        arguments: values of the xacro file's arguments, by name; a plain URDF takes none.
        package_dirs: folders of packages that `$(find NAME)` looks in first.

    Raises:
        OutsideError: it cannot be read or expanded, or not within the bounds of
            `symbolic.robot.xacro_process`.
    """
    content = outside.read_bytes(path, outside.URDF_BYTES)
    if not is_xacro(content):
        return content
    key = (path, content, arguments, tuple(package_dirs))
    expanded, parts = _expanded(*key)
    if parts != _state(path for path, _ in parts):  # an included file has changed since
        _expanded.cache_clear()
        expanded, _ = _expanded(*key)
    if expanded is None:
        raise OutsideError(
            f"takes longer than {CPU_SECONDS} s to be expanded; does a macro call itself, or an "
            "expression count too far?"
        )
    return expanded


def is_xacro(content: bytes) -> bool:
    """Whether a description holds macros to be expanded; generated URDFs often keep the name."""
    return XACRO_NAMESPACE in content and _MACRO.search(content) is not None


@lru_cache(maxsize=8)
def _expanded(
    path: Path, content: bytes, arguments: Arguments, package_dirs: tuple[Path, ...]
) -> tuple[bytes | None, Parts]:
    """The expanded text, and path and digest of every file that was included.

    The text is None where it took too long: that is remembered too, since both robots of a cell
    may name the file.
    """
    answer = _answer(
        {
            "path": str(path.absolute()),
            "arguments": dict(arguments),
            "package_dirs": [str(folder.absolute()) for folder in package_dirs],
        }
    )
    if answer is None:
        return None, ()
    if "refused" in answer:
        raise OutsideError(answer["refused"])
    return answer["urdf"].encode(), _state(answer["included"])


def _answer(request: Any) -> Any:
    """What the process says to a request; None where it takes too long."""
    paths = [os.path.abspath(entry) for entry in sys.path]
    with tempfile.TemporaryFile() as answer:
        try:
            code = subprocess.run(
                [sys.executable, "-P", "-m", _PROCESS],
                input=json.dumps(request).encode(),
                stdout=answer,
                stderr=subprocess.DEVNULL,
                env=os.environ | {"PYTHONPATH": os.pathsep.join(paths)},
                timeout=WAIT_SECONDS,
                check=False,
            ).returncode
        except subprocess.TimeoutExpired:
            return None
        if code in (-signal.SIGXCPU, -signal.SIGKILL):
            return None
        answer.seek(0)
        try:
            return json.loads(answer.read())
        except ValueError as error:
            raise OutsideError(
                f"holds xacro macros that cannot be expanded: their process ended with code {code}"
            ) from error


def _state(paths: Iterable[str]) -> Parts:
    """Each file with the digest of its content; with nothing where it is missing."""
    return tuple((path, _digest(path) if os.path.exists(path) else b"") for path in paths)


def _digest(path: str) -> bytes:
    return hashlib.sha256(outside.read_bytes(Path(path), outside.URDF_BYTES)).digest()
