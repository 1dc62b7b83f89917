"""Places of robot descriptions and meshes, and the expansion of xacro macros.

Packages are looked up in given folders, above the description, in the folders of ROS's environment
variables, and beside the installed Python packages.

The package xacro expands macros in a separate process: `python -m symbolic.read.descriptions`.
Expansion evaluates Python expressions and calls macros as often as the file asks for. So the
process has limits on time and memory, writes no file and starts no other process. It reads a
request as JSON and answers as JSON. The package `xacrodoc`, which wraps xacro, is not used: it
keeps one list of packages per process, and loses the folder to which relative includes refer.
"""

from __future__ import annotations

import errno
import hashlib
import io
import json
import os
import re
import resource
import signal
import site
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

from symbolic import safe_io
from symbolic.errors import OutsideError

PACKAGE_SCHEME = "package://"
DEEPEST_PACKAGE = 4
"""Number of levels below a folder of ROS_PACKAGE_PATH within which a package is looked for."""

LONGEST_NAME = 200

RELATIVE = ("./", "../")
"""Beginnings of a xacro argument that mark a path relative to the workcell file."""

_PACKAGE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")
_PACKAGE = re.compile(rb"<name>\s*([^<\s]+)\s*</name>")
_SKIPPED = ("build", "devel", "install", "log")


def find_package(name: str, package_dirs: Sequence[Path], description: Path) -> Path | None:
    """Return the folder of a package, or None if there is none.

    The package NAME is looked for in this order: in one of `package_dirs`; as a folder NAME above
    the description; as `share/NAME` below each prefix of AMENT_PREFIX_PATH; in a folder of
    ROS_PACKAGE_PATH or at most `DEEPEST_PACKAGE` levels below it; as `share/NAME` of the Python
    environment, and of the prefix in it that wheels of robotics libraries share (`cmeel.prefix`).
    In the first two places a folder with another name counts too if its package.xml says NAME.

    Args:
        name: name of the package.
        package_dirs: folders of packages that the workcell names.
        description: the file that names the package.
    """
    if len(name) > LONGEST_NAME or not _PACKAGE_NAME.fullmatch(name):
        return None
    return next(_packages(name, package_dirs, description), None)


def _packages(name: str, package_dirs: Sequence[Path], description: Path) -> Iterator[Path]:
    """Yield the folders of a package, in the order of precedence that `find_package` states.

    Args:
        name: name of the package.
        package_dirs: folders of packages that the workcell names.
        description: the file that names the package.
    """
    for folder in package_dirs:
        package = package_in(folder, name)
        if package is not None:
            yield package
    for parent in description.resolve().parents:
        if parent.name == name or _package_name(parent) == name:
            yield parent
    shared = [prefix / "share" / name for prefix in _paths("AMENT_PREFIX_PATH")]
    yield from filter(Path.is_dir, shared)
    for folder in _paths("ROS_PACKAGE_PATH"):
        yield from _below(folder, name, DEEPEST_PACKAGE)
    site_folders = (*site.getsitepackages(), *filter(None, sys.path))
    prefixes = (Path(sys.prefix), *(Path(folder) / "cmeel.prefix" for folder in site_folders))
    yield from filter(Path.is_dir, (prefix / "share" / name for prefix in prefixes))


def package_in(folder: Path, name: str) -> Path | None:
    """Return the folder of a package inside a folder; None if there is none.

    This is the subfolder called `name`, else a subfolder whose package.xml has this name.
    """
    if os.path.isdir(folder / name):
        return folder / name
    try:
        inner = sorted(entry for entry in folder.iterdir() if _package_name(entry) == name)
    except OSError:
        return None
    return inner[0] if inner else None


def _package_name(folder: Path) -> str | None:
    """Return the name that a folder's package.xml states; None if the file is missing, cannot be
    read or states none."""
    file = folder / "package.xml"
    if not file.is_file():
        return None
    try:
        found = _PACKAGE.search(safe_io.read_bytes(file, safe_io.WORKCELL_BYTES))
    except OutsideError:
        return None
    return found[1].decode("utf-8", "replace") if found else None


def further_package_dirs(
    addresses: Iterable[str], package_dirs: Sequence[Path], description: Path
) -> tuple[Path, ...]:
    """Return the folders that contain the packages of mesh addresses, as far as these folders are
    not in `package_dirs`.

    Each folder is listed once. Packages that are not found are left out.

    Args:
        addresses: addresses of meshes.
        package_dirs: folders of packages that the workcell names.
        description: the file with the addresses.
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


def _below(folder: Path, name: str, levels: int) -> Iterator[Path]:
    """Yield folders of the package `name`: a folder itself, or folders up to `levels` below it."""
    is_package = (folder / "package.xml").is_file()
    if folder.name == name and is_package:
        yield folder
    try:
        inner = sorted(entry for entry in folder.iterdir() if entry.is_dir())
    except OSError:
        return
    if levels and not is_package:  # packages do not hold packages
        for entry in inner:
            if not entry.name.startswith(".") and entry.name not in _SKIPPED:
                yield from _below(entry, name, levels - 1)


def resolve_mesh(address: str, urdf: Path, package_dirs: Sequence[Path]) -> Path | None:
    """Return the file behind a mesh address of a URDF, or None if it does not exist.

    For `package://NAME/REST` it is the first existing file REST in a package NAME, which
    `package_in` finds inside each folder of `package_dirs`. A `file://` address is absolute; any
    other address is relative to the folder of the URDF.

    Args:
        address: the address in the URDF.
        urdf: path of the URDF.
        package_dirs: folders in which packages are looked up, in order.
    """
    if address.startswith(PACKAGE_SCHEME):
        name, _, rest = address.removeprefix(PACKAGE_SCHEME).partition("/")
        packages = (package_in(folder, name) for folder in package_dirs)
        candidates = [package / rest for package in packages if package is not None]
    else:
        candidates = [urdf.parent / address.removeprefix("file://")]
    return next(
        (candidate.resolve() for candidate in candidates if os.path.exists(candidate)), None
    )


# --- xacro ---


WAIT_SECONDS = 60.0
"""Longest time to wait for an expansion [s]. Its computing time has a tighter limit."""

_XACRO = re.compile(rb"xmlns:xacro\s*=")
"""Declaration of the xacro prefix. xacro looks at the prefix only, since files give several
addresses."""
_EXPANDED = "expanded from xacro"
"""Comment in an expanded description. Its workcell keeps the arguments that it was made with."""

_MACRO = re.compile(rb"<xacro:|\$\{|\$\(")
_MJCF = re.compile(rb"\s*+(?:(?><\?.*?\?>|<!--.*?-->)\s*+)*+<mujoco[\s/>]", re.DOTALL)
_PROCESS = "symbolic.read.descriptions"

Arguments = tuple[tuple[str, str], ...]
Parts = tuple[tuple[str, bytes], ...]


def description_content(
    path: Path, arguments: Arguments = (), package_dirs: Sequence[Path] = ()
) -> bytes:
    """Return the URDF text of a robot's description: unchanged, expanded from xacro, or converted
    from MJCF.

    Args:
        path: a URDF, a xacro or an MJCF file.
        arguments: values of the xacro file's arguments, by name; a plain URDF takes none.
        package_dirs: folders of packages in which `$(find NAME)` looks first.

    Raises:
        OutsideError: the file cannot be read, or cannot be expanded within the limits of time and
            memory.
    """
    content = safe_io.read_bytes(path, safe_io.URDF_BYTES)
    if is_mjcf(content):
        # Not imported at the top: the process that expands xacro has little memory.
        from symbolic.read.mjcf import mjcf_as_urdf

        return mjcf_as_urdf(path, content)
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
            "expression count too far?",
            code="too-slow",
        )
    return expanded


def is_mjcf(content: bytes) -> bool:
    """Return True if the root element of an XML file is that of MuJoCo's format."""
    return _MJCF.match(content) is not None


def is_xacro(content: bytes) -> bool:
    """Return True if a description has macros to expand.

    The suffix of the file does not show this, since generated URDFs often keep `.xacro`.
    """
    return _XACRO.search(content) is not None and _MACRO.search(content) is not None


def takes_arguments(content: bytes) -> bool:
    """Return True if `xacro_arguments` may be given for a file, that is, for a xacro file or a
    description that this project expanded from one.
    """
    return is_xacro(content) or f"<!--{_EXPANDED}-->".encode() in content


_KINEMATICS = re.compile(
    rb"""<xacro:arg\s[^>]*?name\s*=\s*["'](\w*kinematics\w*)["']""", re.IGNORECASE
)
_NOMINAL = re.compile(r"default_kinematics\.ya?ml$", re.IGNORECASE)


def nominal_kinematics(content: bytes, arguments: Arguments) -> str:
    """Return the name of the xacro argument that should state the measured kinematics of an arm but
    does not: it is not given, or its value is the maker's nominal file. Return '' if it is given or
    the file has no such argument.

    Args:
        content: content of the xacro file.
        arguments: values of the file's arguments, by name.
    """
    given = dict(arguments)
    names = (name.decode() for name in _KINEMATICS.findall(content))
    return next(
        (name for name in names if _NOMINAL.search(given.get(name, "")) or name not in given), ""
    )


@lru_cache(maxsize=8)
def _expanded(
    path: Path, content: bytes, arguments: Arguments, package_dirs: tuple[Path, ...]
) -> tuple[bytes | None, Parts]:
    """Expand a xacro file in a process of its own.

    Results are cached, since both robots of a cell may name one file.

    Args:
        path: path of the file.
        content: content of the file, part of the cache's key.
        arguments: values of the file's arguments, by name.
        package_dirs: folders of packages in which `$(find NAME)` looks first.

    Returns:
        URDF text, None if the expansion took too long; path and digest of every included file.
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
        raise OutsideError(answer["refused"], code=answer["code"])
    return answer["urdf"].encode(), _state(answer["included"])


def _answer(request: Any) -> Any:
    """Send a request to expand a xacro file to a new process, and return that process's answer.

    Request and answer are JSON values. The answer is None if the process exceeds its limit of time
    or memory.

    Raises:
        OutsideError: the process ended without an answer.
    """
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
                f"holds xacro macros that cannot be expanded: their process ended with code {code}",
                code="not-expandable",
            ) from error


def _state(paths: Iterable[str]) -> Parts:
    """Return each path with the digest of the file's content, to recognise changed files; the
    digest is empty for a missing file."""
    return tuple((path, _digest(path) if os.path.exists(path) else b"") for path in paths)


def _digest(path: str) -> bytes:
    return hashlib.sha256(safe_io.read_bytes(Path(path), safe_io.URDF_BYTES)).digest()


# --- the process in which xacro runs ---


CPU_SECONDS = 5
"""Longest computing time of an expansion [s]."""

MEMORY_BYTES = 192 * safe_io.MEBIBYTE
MEMORY_PER_BYTE = 6
"""Limit of memory per byte of the file, beyond a fixed amount."""

ANSWER_BYTES = 8 * safe_io.URDF_BYTES
"""Largest size of an answer [bytes]. JSON may take six bytes for a character."""

_REFUSED = ("os.", "subprocess.", "socket.", "shutil.", "ctypes.", "resource.", "signal.", "pty.")
_LOOKING = ("os.listdir", "os.scandir", "os.walk")
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC


def main() -> int:
    """Expand the xacro file that a JSON request on standard input names, and write the answer as
    JSON to standard output: the URDF and the included files, or the reason of a refusal.

    This function runs in a process of its own. It returns the exit code 0.
    """
    request = json.load(sys.stdin)
    path = Path(request["path"])
    answer, sys.stdout = sys.stdout, io.StringIO()
    import xacro
    import xacro.substitution_args  # their own files are read before the limits

    _limit(os.stat(path).st_size)
    try:
        found = _expand(xacro, path, request["arguments"], request["package_dirs"])
    except Exception as error:  # a macro may raise anything
        refusal = _refusal(error, xacro)
        found = {"refused": str(refusal), "code": refusal.code}
    json.dump(found, answer)
    answer.flush()
    return 0


def _limit(size: int) -> None:
    """Limit what this process may do while it expands a xacro file: its processor time, the size of
    its output, its memory, and its access to the system (`_refuse_access`).

    Args:
        size: size of the input [bytes], for which memory is granted.
    """
    for kind, most in (
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_CPU, CPU_SECONDS),
        (resource.RLIMIT_FSIZE, ANSWER_BYTES),
        (resource.RLIMIT_AS, MEMORY_BYTES + MEMORY_PER_BYTE * size),
    ):
        _, hard = resource.getrlimit(kind)
        most = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(kind, (most, most))
    sys.addaudithook(_refuse_access)


def _refuse_access(event: str, arguments: tuple[Any, ...]) -> None:
    """Refuse every access to the system except reading files, while a xacro file is expanded. The
    function is an audit hook of Python.

    Args:
        event: name of the audit event.
        arguments: values that Python passes with the event.
    """
    writes = event == "open" and isinstance(arguments[2], int) and arguments[2] & _WRITING
    if writes or (event.startswith(_REFUSED) and event not in _LOOKING):
        raise OutsideError(
            f"holds an expression that does more than compute ({event})", code="not-arithmetic"
        )


def _expand(
    xacro: Any, path: Path, arguments: Mapping[str, str], package_dirs: list[str]
) -> dict[str, Any]:
    """Expand a xacro file in this process.

    Args:
        xacro: the module `xacro`.
        path: path of the file.
        arguments: values of the file's arguments, by name.
        package_dirs: folders of packages in which `$(find NAME)` looks first.

    Returns:
        The URDF text under the key `urdf`, the paths of the included files under `included`.
    """
    found: dict[str, Path] = {}

    def find(name: str) -> str:
        package = find_package(name, [Path(folder) for folder in package_dirs], path)
        if package is None:
            raise OutsideError(
                f"names the package {name!r}, which is not found; name the folder that holds it "
                "in package_dirs, or set ROS_PACKAGE_PATH or AMENT_PREFIX_PATH",
                code="package-not-found",
            )
        found[name] = package
        return str(package)

    xacro.substitution_args._eval_find = find
    xacro.open = _opened  # stands before Python's own in that module
    document = xacro.process_file(str(path), mappings=dict(arguments))
    for mesh in document.getElementsByTagName("mesh"):
        mesh.setAttribute("filename", _by_package(mesh.getAttribute("filename"), found))
    root = document.documentElement
    root.insertBefore(document.createComment(_EXPANDED), root.firstChild)
    # What stands beside the root are comments that name this machine's folders.
    text = root.toxml()
    if len(text) > safe_io.URDF_BYTES:
        raise OutsideError(
            f"expands to more than {safe_io.megabytes(safe_io.URDF_BYTES)}, which is the limit",
            code="too-large",
        )
    return {"urdf": text, "included": list(dict.fromkeys(map(str, xacro.all_includes)))}


def _opened(name: str) -> io.StringIO:
    """Open a file that a xacro file includes.

    A missing file raises `FileNotFoundError`, which xacro ignores for an optional include.

    Raises:
        OutsideError: the file cannot be read or is too large.
    """
    if not os.path.exists(name):
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), name)
    try:
        return io.StringIO(safe_io.text(safe_io.read_bytes(Path(name), safe_io.URDF_BYTES)))
    except OutsideError as error:
        raise OutsideError(f"includes {Path(name).name}, which {error}") from error


def _by_package(address: str, packages: Mapping[str, Path]) -> str:
    """Return the portable form of a mesh address: the folder of one of the packages is replaced by
    `package://NAME`. An address in no package is returned unchanged.

    Args:
        address: the address.
        packages: folder of each package by name.
    """
    for name, folder in packages.items():
        start = f"{folder}/"
        if address.removeprefix("file://").startswith(start):
            return f"{PACKAGE_SCHEME}{name}/{address.removeprefix('file://').removeprefix(start)}"
    return address


def _refusal(error: BaseException, xacro: Any) -> OutsideError:
    """Convert an error during an expansion to an `OutsideError`. The message names the file and the
    macro in which the error arose.

    Args:
        error: the error.
        xacro: the module `xacro`, whose stacks hold the open files and macros.
    """
    causes = [error]
    for one in causes:  # an error and those that it was made of
        inner = (getattr(one, "exc", None), one.__cause__, one.__context__)
        new = [cause for cause in inner if isinstance(cause, BaseException)]
        causes += [cause for cause in new if all(cause is not met for met in causes)]
    for cause in causes:
        if isinstance(cause, OutsideError):
            return cause
    files = [Path(file).name for file in xacro.filestack or () if file is not None]
    macros = [macro.body.getAttribute("name") for macro in xacro.macrostack or ()]
    where = [f"file {files[-1]}"] if len(files) > 1 else []
    where += [f"macro {macros[-1]}"] if macros else []
    place = f" ({', '.join(where)})" if where else ""
    if any(isinstance(cause, MemoryError) for cause in causes):
        return OutsideError(
            f"needs too much memory to be expanded{place}; simplify its expressions and macros",
            code="too-much-memory",
        )
    if any(isinstance(cause, RecursionError) for cause in causes):
        return OutsideError(
            f"is nested too deeply to be expanded{place}; does a macro call or a file include "
            "itself?",
            code="too-deep",
        )
    reason = " ".join(str(error).split()) or type(error).__name__
    return OutsideError(
        f"holds xacro macros that cannot be expanded: {reason[:300]}{place}",
        code="not-expandable",
    )


if __name__ == "__main__":
    sys.exit(main())
