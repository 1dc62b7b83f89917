"""Options of the programs: each is described once, what a number may be is said before any work."""

from __future__ import annotations

import argparse
import ast
from collections.abc import Callable
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar

LARGEST_SEED = 2**63 - 1

QUICK_EVALUATIONS, QUICK_REPLICAS = 300, 2
"""Evaluations and replicas of a small but complete study."""

DRIVEN = "pads-driven"

PADS = ("pads", DRIVEN)
"""The witnesses without arms, beside the controllers of those with them."""

Number = TypeVar("Number", int, float)


def whole(low: int, high: int) -> Callable[[str], int]:
    """A type of options that takes whole numbers of a range, ends included."""
    return _within(int, low, high, f"a whole number {low} to {high}")


def number(low: float, high: float) -> Callable[[str], float]:
    """A type of options that takes finite numbers of a range, ends included."""
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
"""The type of seeds."""


force = number(1e-3, 1e6)
"""The type of normal forces [N], and of durations [s] and masses [kg] that are wished for."""


_SHARED: dict[str, dict[str, Any]] = {
    "WORKCELL": {"type": Path, "help": "the workcell file"},
    "PROBLEM": {"type": Path, "help": "the problem file"},
    "RESULTS": {"type": Path, "help": "results folder of a study"},
    "FILE": {"help": "a trajectory file"},
    "--classes": {"type": whole(1, 100), "default": 1, "metavar": "N"},
    "--force-limit": {"type": force, "metavar": "N"},
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
    "--output": {"type": Path},
    "--quiet": {
        "action": "store_true",
        "help": "no progress on standard error (default: shown)",
    },
    "--seed": {"type": seed, "default": 1, "metavar": "N", "help": "of the randomness"},
    "--time": {"type": number(1.0, 1e6), "metavar": "S"},
}


def add(parser: argparse._ActionsContainer, *names: str, **own: Any) -> None:
    """Add options that several programs have.

    Args:
        names: of the table; of one that stands by its place in capitals.
        own: what of it differs in this program.
    """
    for name in names:
        place = {} if name.startswith("-") else {"metavar": name}
        parser.add_argument(name.lower(), **(place | _SHARED[name] | own))


def add_wishes(parser: argparse._ActionsContainer, more: str = "") -> None:
    """Add what may be asked of the recommended carry; `Wish` takes it. `more` says what else the
    program does with a limit of the force."""
    parser.add_argument(
        "--duration",
        type=force,
        metavar="S",
        help="recommend the least force of the carries of at most S seconds (default: the least "
        "product of duration and commanded force)",
    )
    add(
        parser,
        "--force-limit",
        help=f"recommend the shortest carry that needs at most N newtons commanded{more} (default: "
        "the least product of duration and commanded force)",
    )
    parser.add_argument(
        "--payload",
        type=force,
        metavar="KG",
        help="recommend the shortest carry on whose motion the robots would hold a box of KG "
        "kilograms in every case of the uncertainty (default: the least product of duration and "
        "commanded force)",
    )


def add_looks(parser: argparse.ArgumentParser) -> None:
    """Add an animation file and the live view of a study's trajectories."""
    group = parser.add_argument_group("looking at a trajectory")
    group.add_argument(
        "--animation",
        type=Path,
        metavar="FILE",
        help="write the selected trajectory as FILE.gif or FILE.mp4 (default: none)",
    )
    group.add_argument(
        "--view",
        action="store_true",
        help="serve the report's page, where trajectories play, to a browser of this machine",
    )
    group.add_argument("--port", type=whole(0, 65535), default=8080, metavar="N", help="of --view")


def stated(name: str) -> Any:
    """What the source of a module states, without importing the module, which may take seconds.

    Args:
        name: of a constant or of a settings' field, with module and class, as
            'hybrid_opt.campaign.settings.CampaignSettings.seed'.

    Returns:
        The value; of a `Literal` what it allows, of a table its keys.

    Raises:
        LookupError: the source states no such value.
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
    """The classes of some source, and the values that it gives to names."""
    found: dict[str, ast.AST] = {}
    for node in body:
        if isinstance(node, ast.ClassDef):
            found[node.name] = node
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and node.value:
            found[node.target.id] = node.value
        elif isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            found[node.targets[0].id] = node.value
    return found
