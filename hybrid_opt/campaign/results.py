"""Reading a campaign's results folder back into frozen records.

Nothing stored is executed, and files are compared with the checksums taken when they were
written. docs/results.md describes the folder.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.campaign.evaluations_file import EvaluationTable, decode
from hybrid_opt.campaign.identity import FORMAT, VERSION
from hybrid_opt.campaign.layout import (
    CONFIGURATION,
    DONE,
    EVALUATIONS,
    SUMMARY,
    replica_folder,
)
from hybrid_opt.campaign.replica import front_rows
from hybrid_opt.errors import ResultsError
from hybrid_opt.evaluate.evaluation import Evaluations
from hybrid_opt.store.files import read_bytes, read_json, sha256
from symbolic.array import Array
from symbolic.workcell.file import load
from symbolic.workcell.records import Workcell


@dataclass(frozen=True)
class Replica:
    """A finished replica; arrays are read-only.

    Attributes:
        algorithm: its name.
        replica: its number, from 0.
        evaluations: every candidate in the order of evaluation.
        generation: (n,) the generation of each, from 1.
        front_rows: (k,) rows of the non-dominated feasible candidates, by increasing objectives.
        seconds: what the search took.
    """

    algorithm: str
    replica: int
    evaluations: Evaluations
    generation: NDArray[np.int64]
    front_rows: NDArray[np.intp]
    seconds: float

    @property
    def front(self) -> Array:
        """(k, n_obj) objectives of the non-dominated feasible candidates."""
        return self.evaluations.objectives[self.front_rows]

    @property
    def front_x(self) -> Array:
        """(k, n_var) their decision vectors."""
        return self.evaluations.x[self.front_rows]


@dataclass(frozen=True)
class CampaignResults:
    """A campaign whose search is complete.

    Attributes:
        root: the results folder.
        configuration: what is in its configuration.json.
        workcell: as read from the folder's copy.
        algorithms, objectives: names, in order.
        replicas: of all algorithms, by algorithm and number.
    """

    root: Path
    configuration: Mapping[str, Any]
    workcell: Workcell
    algorithms: tuple[str, ...]
    objectives: tuple[str, ...]
    replicas: tuple[Replica, ...]

    def of(self, algorithm: str) -> tuple[Replica, ...]:
        """The replicas of one algorithm."""
        return tuple(found for found in self.replicas if found.algorithm == algorithm)


def read_campaign(root: str | Path) -> CampaignResults:
    """Read a campaign whose search is complete.

    Raises:
        ResultsError: the folder holds none, a replica is missing, or a file is damaged.
        WorkcellError: the stored workcell cannot be read.
    """
    root = Path(root)
    configuration = read_configuration(root)
    try:
        algorithms = tuple(configuration["settings"]["algorithms"])
        objectives = tuple(configuration["settings"]["objectives"])
        count = int(configuration["settings"]["replicas"])
        file, digest = (configuration["workcell"][key] for key in ("file", "digest"))
    except (KeyError, TypeError, ValueError) as error:
        raise ResultsError(f"{root / CONFIGURATION}: damaged ({error!r})") from error
    path = (root / str(file)).resolve()
    if not path.is_relative_to(root.resolve()):
        raise ResultsError(f"{root / CONFIGURATION}: names a workcell outside of the folder")
    workcell = load(path)
    if workcell.digest != digest:
        raise ResultsError(f"{path}: was changed after the campaign began")
    replicas = tuple(
        read_replica(root, algorithm, number, objectives)
        for algorithm in algorithms
        for number in range(count)
    )
    return CampaignResults(root, configuration, workcell, algorithms, objectives, replicas)


def read_configuration(root: str | Path) -> Mapping[str, Any]:
    """The configuration of a campaign.

    Raises:
        ResultsError: the folder holds none, or one of another version.
    """
    path = Path(root) / CONFIGURATION
    if not path.exists():
        raise ResultsError(f"{root}: is no results folder, {CONFIGURATION} is missing")
    configuration = read_json(path)
    if not isinstance(configuration, dict) or configuration.get("format") != FORMAT:
        raise ResultsError(f"{path}: `format` is not {FORMAT!r}")
    if configuration.get("version") != VERSION:
        raise ResultsError(
            f"{path}: version {configuration.get('version')!r}; this program reads {VERSION}"
        )
    return configuration


def read_summary(root: str | Path) -> Mapping[str, Any]:
    """The figures of summary.json.

    Raises:
        ResultsError: it is missing or damaged.
    """
    summary = read_json(Path(root) / SUMMARY)
    if not isinstance(summary, dict):
        raise ResultsError(f"{Path(root) / SUMMARY}: damaged, not an object")
    return summary


def read_replica(root: Path, algorithm: str, number: int, objectives: tuple[str, ...]) -> Replica:
    """Read one finished replica.

    Raises:
        ResultsError: it is not finished, or a file is damaged.
    """
    folder = replica_folder(root, algorithm, number)
    if not (folder / DONE).exists():
        raise ResultsError(
            f"{folder}: {algorithm} replica {number} is not finished; continue the campaign with "
            "--resume"
        )
    marker = read_json(folder / DONE)
    content = read_bytes(folder / EVALUATIONS)
    try:
        intact = sha256(content) == marker["sha256"][EVALUATIONS]
        seconds = float(marker["seconds"])
    except (KeyError, TypeError, ValueError) as error:
        raise ResultsError(f"{folder / DONE}: damaged ({error!r})") from error
    if not intact:
        raise ResultsError(
            f"{folder / EVALUATIONS}: damaged, its checksum differs; --resume computes it anew"
        )
    table = decode(content, folder / EVALUATIONS)
    if table.objective_names != objectives:
        raise ResultsError(f"{folder / EVALUATIONS}: holds other objectives than the campaign")
    return _replica(algorithm, number, table, seconds)


def _replica(algorithm: str, number: int, table: EvaluationTable, seconds: float) -> Replica:
    rows = front_rows(table.evaluations)
    arrays = [getattr(table.evaluations, field.name) for field in fields(Evaluations)]
    for array in (*arrays, table.generation, rows):
        array.setflags(write=False)
    return Replica(algorithm, number, table.evaluations, table.generation, rows, seconds)
