"""Options of the programs, each described once. Numbers, paths and extras are checked before any
work.

Nothing heavy is imported here, so a mistyped name is reported at once.
"""

from __future__ import annotations

import argparse
import ast
import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar

from symbolic import safe_io
from symbolic.errors import OutsideError, SettingsError, WorkcellError
from symbolic.records.problems import suggestion

LARGEST_SEED = 2**63 - 1

QUICK_EVALUATIONS, QUICK_REPLICAS = 300, 2
"""Number of evaluations and replicas of a small but complete study."""

PADS_DRIVEN = "pads-driven"

HANDS = "hands"

PAD_WITNESSES = ("pads", PADS_DRIVEN)
"""Names of the simulations without arms, beside the controllers of simulations with arms."""

Number = TypeVar("Number", int, float)


def whole(low: int, high: int) -> Callable[[str], int]:
    """Return a function that converts the text of an option to an integer from `low` to `high`,
    both included."""
    return _within(int, low, high, f"a whole number {low} to {high}")


def number(low: float, high: float) -> Callable[[str], float]:
    """Return a function that converts the text of an option to a finite number from `low` to
    `high`, both included."""
    return _within(float, low, high, f"a number {low:g} to {high:g}")


def _within(
    kind: Callable[[str], Number], low: Number, high: Number, allowed: str
) -> Callable[[str], Number]:
    def read(text: str) -> Number:
        try:
            value = kind(text)
        except ValueError:  # also from thousands of digits
            value = None
        if value is None or not low <= value <= high:
            shown = ascii(text) if len(text) <= 40 else f"{text[:37]!a}..."
            raise argparse.ArgumentTypeError(f"found {shown}; allowed is {allowed}")
        return value

    return read


seed = whole(0, LARGEST_SEED)
"""Type of options that take a seed."""


force = number(1e-3, 1e6)
"""Type of options that take a normal force [N], or a duration [s] or mass [kg] of a wish."""


@dataclass(frozen=True)
class PathType:
    """Type of a path argument.

    Attributes:
        check: function that raises a `DualArmError` for an unsuitable path; called after the whole
            command line is parsed.
    """

    check: Callable[[Path], None]

    def __call__(self, text: str) -> Path:
        """Convert the text of the argument to a path."""
        return Path(text)


WORKCELL, TRAJECTORY, RESULTS = "a workcell file", "a trajectory file", "a results folder"
"""Kinds of inputs that are recognised by their content."""

_HEAD_BYTES = 4096
"""Number of bytes at the beginning of a JSON file in which its format is looked for."""

_FORMAT = re.compile(rb'"format"\s*:\s*"dual-arm-carry trajectory"')
_SECTION = re.compile(rb"^\s*\[+\s*(task|payload|robots|contacts)\b", re.MULTILINE)


def _kind_of(path: Path) -> str:
    """Return what a file or folder is, judged by its content; '' if unknown."""
    if path.is_dir():
        is_study = (path / stated("hybrid_opt.campaign.settings.CONFIGURATION")).exists()
        return RESULTS if is_study else "a folder"
    try:
        with open(path, "rb") as file:
            head = file.read(_HEAD_BYTES)
            if head.lstrip()[:1] == b"{":
                return TRAJECTORY if _FORMAT.search(head) else ""
            return WORKCELL if _SECTION.search(head + file.read(safe_io.WORKCELL_BYTES)) else ""
    except OSError:
        return ""


def _require_file(path: Path, kind: str = "") -> None:
    """Check that a path can be read as a file.

    Args:
        path: the path.
        kind: expected kind of the file; a file that is recognised as another kind is refused.
    """
    try:
        safe_io.require(path, safe_io.MOST_BYTES)
    except OutsideError as error:
        raise SettingsError(f"{path}: {error}{_expected(path, kind)}") from error
    found = _kind_of(path)
    if kind and found not in ("", kind):
        raise SettingsError(f"{path}: is {found}{_expected(path, kind)}")


def _expected(path: Path, kind: str) -> str:
    """Return the end of a message about an unsuitable path: the expected kind of file, and a file
    that the user may have meant.

    Args:
        path: the unsuitable path.
        kind: expected kind of the file.
    """
    expected = f"; expected is {kind}" if kind else ""
    if not path.exists():
        folder = path.parent
        names = [each.name for each in folder.iterdir()] if folder.is_dir() else []
        return f"{expected}{suggestion(path.name, names)}"
    if kind == TRAJECTORY:
        name = stated("hybrid_opt.campaign.settings.RECOMMENDED_FILE")
        known = path / name if (path / name).exists() else f"results/NAME/{name}"
        return f"{expected}, as studies write it: {known}"
    return expected


def _require_workcell(path: Path) -> None:
    _require_file(path, WORKCELL)
    try:
        safe_io.toml_tables(safe_io.read_bytes(path, safe_io.WORKCELL_BYTES))
    except OutsideError as error:
        raise WorkcellError(str(path), (f"file: {error}",)) from error


def _require_folder(path: Path, kind: str = "a folder") -> None:
    if not path.exists():
        raise SettingsError(f"{path}: does not exist{_expected(path, kind)}")
    if not path.is_dir():
        raise SettingsError(f"{path}: is {_kind_of(path) or 'a file'}{_expected(path, kind)}")


def _require_results(path: Path) -> None:
    _require_folder(path, RESULTS)
    name = stated("hybrid_opt.campaign.settings.CONFIGURATION")
    if not os.path.lexists(path / name):
        raise SettingsError(
            f"{path}: is no results folder, {name} is missing", code="no-results-folder"
        )


def _require_any(path: Path) -> None:
    if not path.exists():
        raise SettingsError(f"{path}: does not exist{_expected(path, '')}")


def _require_recording(path: Path) -> None:
    """Check that a recording exists: its settings RUN.toml, or the file itself. A recording with
    one file per arm has RUN.toml only.
    """
    if not path.with_suffix(".toml").exists():
        _require_any(path)


def _require_place(path: Path) -> None:
    """Check that this user can write to a path or create it."""
    existing = next(each for each in (path, *path.absolute().parents) if each.exists())
    if existing != path and not existing.is_dir():
        raise SettingsError(f"{path}: cannot be made, {existing} is a file")
    if not os.access(existing, os.W_OK | (os.X_OK if existing.is_dir() else 0)):
        raise SettingsError(f"{path}: cannot be written, {existing} is read-only for this user")


def _require_output_file(path: Path) -> None:
    if path.is_dir():
        raise SettingsError(f"{path}: is a folder; name a file")
    _require_place(path)


def _require_output_folder(path: Path) -> None:
    if path.exists() and not path.is_dir():
        raise SettingsError(f"{path}: is a file; name a folder")
    _require_place(path)


def _require_film(path: Path) -> None:
    if path.suffix.lower() not in (".gif", ".mp4"):
        raise SettingsError(f"{path}: the name of an animation must end in .gif or .mp4")
    if path.suffix.lower() == ".mp4":
        require_extra("video", "an MP4 (a .gif needs nothing)")
    _require_output_file(path)


WORKCELL_FILE = PathType(_require_workcell)
TRAJECTORY_FILE = PathType(partial(_require_file, kind=TRAJECTORY))
INPUT_FILE = PathType(_require_file)
INPUT_FOLDER = PathType(_require_folder)
INPUT = PathType(_require_any)
RECORDING = PathType(_require_recording)
RESULTS_FOLDER = PathType(_require_results)
OUTPUT_FILE = PathType(_require_output_file)
OUTPUT_FOLDER = PathType(_require_output_folder)
FILM_FILE = PathType(_require_film)
"""What programs read and write. Folders of outputs are made where they are missing."""


def check_paths(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """Check all paths in the parsed `options` of a command line, inputs first, in the order of the
    help.

    Raises:
        DualArmError: a path is not suitable for the program.
    """
    for action in parser._actions:
        value = getattr(options, action.dest, None)
        if isinstance(action.type, PathType) and value is not None:
            for path in value if isinstance(value, list) else [value]:
                action.type.check(path)


EXTRAS = {
    "dask": ("distributed",),
    "live": ("viser",),
    "propose": ("cma",),
    "ros": ("mcap", "rosbags"),
    "sim": ("mujoco",),
    "video": ("imageio_ffmpeg",),
}
"""Modules of each extra of `pyproject.toml` that a program or an option needs."""


def require_extra(extra: str, use: str) -> None:
    """Check that an extra is installed, without importing it.

    Args:
        extra: name of the extra in `EXTRAS`.
        use: the feature that needs it, for the message.

    Raises:
        SettingsError: a module of the extra is missing.
    """
    missing = [name for name in EXTRAS[extra] if find_spec(name) is None]
    if missing:
        command = f"pip install 'dual-arm-carry[{extra}]'"
        text = f"{use} needs {' and '.join(missing)}: {command}"
        raise SettingsError(text, code="missing-extra")


_SHARED: dict[str, dict[str, Any]] = {
    "WORKCELL": {"type": WORKCELL_FILE, "help": "the workcell file"},
    "PROBLEM": {"type": WORKCELL_FILE, "help": "the problem file"},
    "RESULTS": {"type": RESULTS_FOLDER, "help": "results folder of a study"},
    "FILE": {"type": TRAJECTORY_FILE, "help": "a trajectory file"},
    "--classes": {"type": whole(1, 100), "default": 1, "metavar": "N"},
    "--force-limit": {"type": force, "metavar": "N"},
    "--planned-limit": {"type": force, "metavar": "N"},
    "--jobs": {
        "type": whole(0, 4096),
        "default": 0,
        "metavar": "N",
        "help": "worker processes, 0 for one per core",
    },
    "--json": {"action": "store_true", "help": "print JSON instead of text"},
    "--leader": {
        "type": int,
        "choices": (1, 2),
        "default": 1,
        "help": "the arm that keeps its place",
    },
    "--output": {"type": OUTPUT_FOLDER},
    "--paper": {
        "action": "store_true",
        "help": "also draw the paper's pictures, and show the carries of its search on the page",
    },
    "--quiet": {
        "action": "store_true",
        "help": "no progress on standard error (default: shown)",
    },
    "--seed": {"type": seed, "default": 1, "metavar": "N", "help": "seed of the random generator"},
    "--target": {
        "metavar": "NAME",
        "help": "first list the data that the cell lacks for this export target",
    },
    "--time": {"type": number(1.0, 1e6), "metavar": "S"},
}


def add(parser: argparse._ActionsContainer, *names: str, **own: Any) -> None:
    """Add options that several programs share.

    Args:
        parser: parser of the program.
        names: names in the table of options; positional arguments in capitals.
        own: arguments of `add_argument`, such as `help`, that replace those of the table.
    """
    for name in names:
        place = {} if name.startswith("-") else {"metavar": name}
        parser.add_argument(name.lower(), **(place | _SHARED[name] | own))


def add_wishes(parser: argparse._ActionsContainer) -> None:
    """Add the options `--duration`, `--force-limit` and `--payload`, which decide which carry is
    recommended (`Wish`).
    """
    parser.add_argument(
        "--duration",
        type=force,
        metavar="S",
        help="recommend the carry of least force within S seconds (default: the least product of "
        "duration and force)",
    )
    add(
        parser,
        "--force-limit",
        help="recommend the shortest carry within N newtons of commanded force (default: none)",
    )
    parser.add_argument(
        "--payload",
        type=force,
        metavar="KG",
        help="recommend for a box of KG kilograms (default: the mass of the workcell)",
    )


def add_looks(parser: argparse.ArgumentParser) -> None:
    """Add the options for an animation file and a live view of a study's trajectories."""
    group = parser.add_argument_group("looking at a trajectory")
    group.add_argument(
        "--animation",
        type=FILM_FILE,
        metavar="FILE",
        help="write the selected trajectory as FILE.gif or FILE.mp4 (default: none)",
    )
    group.add_argument(
        "--view",
        action="store_true",
        help="serve the report's page, where trajectories play, to a browser of this machine",
    )
    group.add_argument(
        "--port", type=whole(0, 65535), default=8080, metavar="N", help="port of --view"
    )


def stated(name: str) -> Any:
    """Read a constant, or the default of a field, from the source of a module without importing it.

    Args:
        name: name of the constant, or of the field of a settings class, with module and class, such
            as 'hybrid_opt.campaign.settings.CampaignSettings.seed'.

    Returns:
        The value. For a `Literal` the tuple of its values; for a dictionary the tuple of its keys.

    Raises:
        LookupError: the source does not state this value.
    """
    package, *parts = name.split(".")
    spec = find_spec(package)
    if spec is None or spec.origin is None:
        raise LookupError(f"there is no package {package}")
    place = Path(spec.origin).parent
    while (place / parts[0]).is_dir():
        place /= parts.pop(0)
    names = _statements(place / f"{parts.pop(0)}.py")
    value = names[parts.pop(0)]
    if isinstance(value, ast.ClassDef):
        value = _named(value.body)[parts.pop(0)]
    if isinstance(value, ast.Name):
        value = names[value.id]
    if isinstance(value, ast.Subscript):
        return ast.literal_eval(value.slice)
    if isinstance(value, ast.Dict):
        return tuple(ast.literal_eval(key) for key in value.keys if key is not None)
    return ast.literal_eval(value)


@cache
def _statements(path: Path) -> dict[str, ast.AST]:
    return _named(ast.parse(path.read_text("utf-8")).body)


def _named(body: list[ast.stmt]) -> dict[str, ast.AST]:
    """Return the syntax trees of the classes and of the assigned values in a source, by the name of
    the class or variable.

    Args:
        body: statements of the source.
    """
    found: dict[str, ast.AST] = {}
    for node in body:
        if isinstance(node, ast.ClassDef):
            found[node.name] = node
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and node.value:
            found[node.target.id] = node.value
        elif isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            found[node.targets[0].id] = node.value
    return found
