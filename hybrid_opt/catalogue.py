"""What there is to choose from, and what was stored: `hybrid_opt` exports all of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from hybrid_opt.cell import Cell
from hybrid_opt.evaluate.objectives import OBJECTIVES, PAPER_OBJECTIVES, Objective
from symbolic.errors import SettingsError

if TYPE_CHECKING:
    from hybrid_opt.campaign.results import CampaignResults
    from hybrid_opt.carry import Carry

# What writes bundles and searches takes a second to import and is not needed for an example.

_OPENED: list[TemporaryDirectory[str]] = []
"""What the cells of trajectory files were unpacked into, until the process ends."""


def load(path: str | Path) -> Cell | Carry | CampaignResults | Mapping[str, Any]:
    """Read back what this project wrote: a workcell file as a `Cell`, a trajectory file as a
    `Carry`, the results folder of a study as its fronts (`.cell`, `.fronts`), a bundle as its
    manifest.

    Raises:
        WorkcellError: the workcell file is wrong.
        ResultsError: there is nothing of the kind, or it is damaged.
    """
    from hybrid_opt.bundles.bundle import MANIFEST, read_manifest
    from hybrid_opt.campaign.results import read_campaign
    from hybrid_opt.store.trajectory_file import read_trajectory

    path = Path(path)
    if path.suffix == ".toml":
        return Cell.load(path)
    if not path.is_dir():
        stored = read_trajectory(path)
        _OPENED.append(TemporaryDirectory())
        return stored.open_cell(Path(_OPENED[-1].name)).carry(stored.x)
    if (path / MANIFEST).exists():
        return read_manifest(path)
    return read_campaign(path)


def example(name: str = "rack", objectives: Sequence[str | Objective] = PAPER_OBJECTIVES) -> Cell:
    """A cell that ships with the project.

    Raises:
        SettingsError: there is none of that name; the message lists them.
    """
    folder = Path(str(files("studies"))) / "workcells"
    known = sorted(path.stem for path in folder.glob("*.toml"))
    if name not in known:
        raise SettingsError(f"no cell {name!r} ships; known are {', '.join(known)}")
    return Cell.load(folder / f"{name}.toml", objectives)


def algorithms() -> dict[str, str]:
    """The searches that `search` knows, by name what they are called in print."""
    from hybrid_opt.metaheuristics.registry import names, title

    return {name: title(name) for name in names()}


def objectives() -> dict[str, str]:
    """The objectives that a `Cell` may minimise, by name what they are."""
    return {name: objective.title for name, objective in OBJECTIVES.items()}


def targets() -> dict[str, str]:
    """What `export` writes for, by name how it is run."""
    from hybrid_opt.bundles.bundle import TARGETS

    return {name: target.how_to_run for name, target in TARGETS.items()}
