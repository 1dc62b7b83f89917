"""Readers of a campaign's results folder, and of all other files of this project.

Stored content is never executed, and files are compared with the checksums that were taken when
they were written. docs/reference/results.md describes the folder.
"""

from __future__ import annotations

import html
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.campaign.candidates import decode
from hybrid_opt.campaign.folder import CAMPAIGN_FORMAT, CAMPAIGN_VERSION
from hybrid_opt.campaign.settings import (
    CONFIGURATION,
    RECOMMENDED_FILE,
    UNION,
    CampaignSettings,
    Configuration,
    polished_file,
    replica_file,
)
from hybrid_opt.carry import Carry
from hybrid_opt.cell import Cell
from hybrid_opt.display.table import counted, figures_html, lines
from hybrid_opt.errors import DamagedResultsWarning, ResultsError
from hybrid_opt.evaluate.evaluation import Evaluations, concatenated
from hybrid_opt.evaluate.objectives import front_rows
from hybrid_opt.front import Front
from hybrid_opt.polishing.front import PolishedFront
from hybrid_opt.store.bundle_file import MANIFEST, read_manifest
from hybrid_opt.store.files import (
    from_json,
    read_bytes,
    read_document,
    record_of,
)
from hybrid_opt.store.trajectory_file import read_trajectory
from symbolic.array import Array, set_read_only
from symbolic.read.cell import load as load_workcell
from symbolic.records import Workcell

RECOMPUTE_REMEDY = "--resume computes it anew"

CACHED_TABLES = 64
"""Largest number of decoded tables, and of polished fronts, in memory. Stages read them often."""

_decoded = lru_cache(maxsize=CACHED_TABLES)(decode)
_record_of = lru_cache(maxsize=CACHED_TABLES)(record_of)


@dataclass(frozen=True)
class Replica:
    """Finished search of one replica; arrays are read-only.

    Attributes:
        algorithm: name of the search algorithm.
        replica: number of the replica, from 0.
        evaluations: every candidate in the order of evaluation.
        seconds: duration of the search [s].
    """

    algorithm: str
    replica: int
    evaluations: Evaluations
    seconds: float

    def __post_init__(self) -> None:
        set_read_only(self.evaluations)

    @cached_property
    def front_rows(self) -> NDArray[np.intp]:
        """(k,) indices into `evaluations` of the non-dominated feasible candidates, by increasing
        first objective.
        """
        return front_rows(self.evaluations.objectives, self.evaluations.feasible)

    @property
    def front(self) -> Array:
        """(k, n_obj) objectives of the non-dominated feasible candidates."""
        return self.evaluations.objectives[self.front_rows]

    @property
    def front_x(self) -> Array:
        """(k, n_var) decision vectors of the non-dominated feasible candidates."""
        return self.evaluations.x[self.front_rows]


@dataclass(frozen=True, repr=False)
class CampaignResults:
    """Results of a campaign whose searches are all complete.

    Attributes:
        root: the results folder.
        configuration: content of configuration.json in the results folder.
        cell: cell of the workcell copy in the folder, with the objectives of the study.
        replicas: replicas of all algorithms, ordered by algorithm and number.
    """

    root: Path
    configuration: Configuration
    cell: Cell
    replicas: tuple[Replica, ...]

    def __repr__(self) -> str:
        return "\n".join([self._heading, *lines(self._figures)])

    def _repr_html_(self) -> str:
        return f"<div><p>{html.escape(self._heading)}</p>{figures_html(self._figures)}</div>"

    @property
    def _heading(self) -> str:
        settings = self.settings
        return (
            f"Study of {self.workcell.name!r} in {self.root}: "
            f"{counted(settings.replicas, 'replica')} of {settings.evaluations} evaluations, "
            f"seed {settings.seed}"
        )

    @property
    def _figures(self) -> dict[str, str]:
        """Texts by title for the display. Per algorithm, and per algorithm after the polish, they
        state the number of fronts and their sizes. The last one is the file of the recommended
        carry, if there is one."""
        sizes: dict[str, list[int]] = {}
        for front in self.fronts:
            sizes.setdefault(front.title, []).append(len(front))
        found = {
            title: f"{counted(len(each), 'front')}, carries: {min(each)} to {max(each)}"
            for title, each in sizes.items()
        }
        recommended = self.root / RECOMMENDED_FILE
        return found | ({"carry to run": str(recommended)} if recommended.exists() else {})

    @property
    def workcell(self) -> Workcell:
        """Description of the cell."""
        return self.cell.workcell

    @property
    def settings(self) -> CampaignSettings:
        """Settings of the campaign."""
        return self.configuration.settings

    @property
    def algorithms(self) -> tuple[str, ...]:
        """Names of the search algorithms, in the order of the settings."""
        return tuple(self.settings.algorithms)

    @property
    def objectives(self) -> tuple[str, ...]:
        """Names of the objectives, in the order of the settings."""
        return self.settings.objectives

    def of(self, algorithm: str) -> tuple[Replica, ...]:
        """Return the replicas of one algorithm, by replica number.

        Args:
            algorithm: name of the algorithm.
        """
        return tuple(found for found in self.replicas if found.algorithm == algorithm)

    @cached_property
    def searched(self) -> tuple[Front, ...]:
        """Fronts of all replicas before the polish."""
        return tuple(
            Front.of_search(self.cell, found.algorithm, found.evaluations, found.replica)
            for found in self.replicas
        )

    @cached_property
    def to_polish(self) -> tuple[Front, ...]:
        """Fronts from which the polish starts.

        These are the fronts of all replicas. For a drivable cell, whose carries are timed from rest
        to rest within all limits, it is a single front, called `UNION`, of the non-dominated
        candidates of all replicas together.
        """
        if not self.workcell.task.law.is_drivable:
            return self.searched
        every = concatenated([found.evaluations for found in self.replicas])
        return (Front.of_search(self.cell, UNION, every),)

    @property
    def fronts(self) -> tuple[Front, ...]:
        """Fronts of all replicas, each followed by its polished front if there is one.

        The polished front of all replicas together comes last, if there is one.

        Raises:
            ResultsError: the file of a polished front is damaged.
        """
        found = list[Front | None]()
        for front in self.searched:
            found += [front, self.polished(*front.key)]
        return tuple(front for front in (*found, self.polished(UNION)) if front is not None)

    def polished(self, algorithm: str, replica: int = 0) -> Front | None:
        """Return the polished front of a replica, or of all replicas together; None if it was not
        polished.

        Args:
            algorithm: name of the algorithm; `UNION` for all replicas together.
            replica: number of the replica, from 0.

        Raises:
            ResultsError: the file of the polished front is damaged.
        """
        for front in self.to_polish:
            if front.key == (algorithm, replica):
                found = read_polished(self.root, front)
                return None if found is None else front.after(found)
        return None


def union(fronts: Sequence[Front]) -> list[tuple[Front, int]]:
    """Find the carries that no carry of several fronts dominates.

    Args:
        fronts: fronts with the same objectives.

    Returns:
        For each such carry its front and its index in that front, by increasing first objective.
    """
    members = [(front, row) for front in fronts for row in range(len(front))]
    objectives = np.concatenate([front.objectives for front in fronts])
    return [members[k] for k in front_rows(objectives, np.ones(len(members), dtype=bool))]


def read_campaign(root: str | Path) -> CampaignResults:
    """Read a campaign with a complete search.

    Args:
        root: the results folder.

    Raises:
        ResultsError: the folder holds no campaign, a replica is missing, or a file is damaged.
        WorkcellError: the stored workcell cannot be read.
    """
    root = Path(root)
    configuration = read_configuration(root)
    settings = configuration.settings
    path = (root / configuration.workcell.file).resolve()
    if not path.is_relative_to(root.resolve()):
        raise ResultsError(f"{root / CONFIGURATION}: names a workcell outside of the folder")
    workcell = load_workcell(path)
    if workcell.digest != configuration.workcell.digest:
        raise ResultsError(f"{path}: was changed after the campaign began")
    replicas = tuple(
        read_replica(root, algorithm, number, settings.objectives)
        for algorithm in settings.algorithms
        for number in range(settings.replicas)
    )
    return CampaignResults(root, configuration, Cell(workcell, settings.objectives), replicas)


def read_configuration(root: str | Path) -> Configuration:
    """Read the configuration of a campaign.

    Args:
        root: the results folder.

    Raises:
        ResultsError: the configuration is missing, damaged, or of another version.
    """
    path = Path(root) / CONFIGURATION
    if not path.parent.exists():
        raise ResultsError(
            f"{root}: does not exist; name the results folder of a study", code="no-results-folder"
        )
    if not path.exists():
        raise ResultsError(
            f"{root}: is no results folder, {CONFIGURATION} is missing", code="no-results-folder"
        )
    remedy = "run the study again into another --output"
    return from_json(
        Configuration, read_document(path, CAMPAIGN_FORMAT, CAMPAIGN_VERSION, remedy), path, remedy
    )


def read_replica(root: Path, algorithm: str, number: int, objectives: tuple[str, ...]) -> Replica:
    """Read one replica with a finished search.

    Args:
        root: the results folder.
        algorithm: name of the search algorithm.
        number: number of the replica, from 0.
        objectives: names of the campaign's objectives, in order.

    Raises:
        ResultsError: the search is not finished, or the file is damaged.
    """
    path = replica_file(root, algorithm, number)
    if not path.exists():
        raise ResultsError(
            f"{path}: {algorithm} replica {number} is not finished; continue the campaign with "
            "--resume"
        )
    found = _decoded(read_bytes(path), path)
    if found.objective_names != objectives:
        raise ResultsError(f"{path}: holds other objectives than the campaign; {RECOMPUTE_REMEDY}")
    return Replica(algorithm, number, found.evaluations, found.seconds)


def is_whole(exists: bool, read: Callable[[], object]) -> bool:
    """Return True if a stored result exists and can be read. Warn of a damaged one.

    Args:
        exists: True if the result exists.
        read: function that reads the result, and raises a `ResultsError` if it is damaged.
    """
    try:
        if exists:
            read()
    except ResultsError as error:
        told = str(error).removesuffix(f"; {RECOMPUTE_REMEDY}")
        warnings.warn(f"{told}; {RECOMPUTE_REMEDY}", DamagedResultsWarning, stacklevel=2)
        return False
    return exists


def read_polished(root: Path, front: Front) -> PolishedFront | None:
    """Read the polished front that was made from a front; None if the front was not polished.

    Args:
        root: the results folder.
        front: the front before the polish.

    Raises:
        ResultsError: the file is damaged.
    """
    path = polished_file(root, *front.key)
    if not path.exists():
        return None
    found: PolishedFront = _record_of(PolishedFront, read_bytes(path), path, RECOMPUTE_REMEDY)
    task = front.cell.workcell.task
    problem = ""
    if bool(len(found.x)) != bool(len(front)):
        problem = f"at x: found {len(found.x)} points"
    elif len(found.x) and found.x.shape[1] != task.n_var:
        problem = f"at x: found {found.x.shape[1]} numbers; allowed are {task.n_var}"
    elif len(found.x) and ((found.x < task.lower) | (found.x > task.upper)).any():
        problem = "at x: is outside of the decision variables' bounds"
    if problem:
        raise ResultsError(f"{path}: damaged {problem}; {RECOMPUTE_REMEDY}")
    return found if len(found.x) else replace(found, x=found.x.reshape(0, task.n_var))


_OPENED: list[TemporaryDirectory[str]] = []
"""Folders into which the cells of trajectory files were unpacked. They exist until the process
ends."""


def load(path: str | Path) -> Cell | Carry | CampaignResults | Mapping[str, Any]:
    """Read a file or folder of this project.

    Args:
        path: a workcell file (.toml), a trajectory file, a results folder, or a bundle.

    Returns:
        A `Cell` of a workcell file, a `Carry` of a trajectory file, the `CampaignResults` of a
        results folder, or the manifest of a bundle (JSON values by name).

    Raises:
        WorkcellError: the workcell file is invalid.
        ResultsError: the path is none of these, or the content is damaged.
    """
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
