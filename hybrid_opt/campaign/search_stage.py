"""The first stage of a study: the searches of every algorithm's replicas, spread over the
workers."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hybrid_opt.campaign.candidates import EvaluatedCandidates, encode
from hybrid_opt.campaign.folder import CampaignFolder
from hybrid_opt.campaign.results import is_whole, read_replica
from hybrid_opt.campaign.settings import CampaignSettings, replica_file
from hybrid_opt.campaign.stages import ReplicaFunction, Stage, loaded_cell, store_results
from hybrid_opt.front import search
from hybrid_opt.metaheuristics.run import SearchSettings
from hybrid_opt.progress import Progress, ShowProgress
from symbolic.read.cell_files import CellFiles


@dataclass(frozen=True)
class SearchRequest:
    """Request to run the search of one replica; it can be sent to another process.

    Attributes:
        files: files of the campaign's cell.
        settings: settings of the campaign.
        algorithm: name of the search algorithm.
        replica: number of the replica, from 0.
    """

    files: CellFiles
    settings: CampaignSettings
    algorithm: str
    replica: int


def search_replica(request: SearchRequest, progress: ShowProgress = False) -> bytes:
    """Run the search of one replica and return the content of its file.

    The random numbers depend only on the campaign's seed, the algorithm's name and the replica's
    number.

    Args:
        request: the replica, with the settings and the cell.
        progress: True for a progress bar, or a function of the finished and the total number of
            evaluations.
    """
    settings, algorithm = request.settings, request.algorithm
    cell = loaded_cell(request.files, settings.objectives)
    # None: the hand-made trajectory.
    initial = None if settings.starts_from_initial(algorithm) else np.empty((0, cell.n_var))
    how = SearchSettings(settings.algorithms[algorithm], settings.constraint_handling, initial)
    rng = settings.replica_rng(algorithm, request.replica)
    begin = time.perf_counter()
    front = search(
        cell,
        algorithm,
        evaluations=settings.evaluations,
        rng=rng,
        settings=how,
        progress=progress,
    )
    seconds = time.perf_counter() - begin
    return encode(EvaluatedCandidates(front.evaluations, cell.objective_names, seconds))


def search_stage(function: ReplicaFunction[SearchRequest] = search_replica) -> Stage:
    """Return the stage of a study that runs the searches of all replicas.

    Args:
        function: function that runs one search and returns the content of its file.
    """

    def run(folder: CampaignFolder, progress: Progress) -> None:
        left = {
            path: SearchRequest(folder.files, folder.settings, *key)
            for key, path in _replicas(folder).items()
            if not _is_done(folder, key)
        }
        done = len(_replicas(folder)) - len(left)
        stage = ("search", "evaluations", folder.settings.evaluations)
        store_results(folder, progress, stage, function, left, done)

    def whole(folder: CampaignFolder) -> bool:
        return all(_is_done(folder, key) for key in _replicas(folder))

    return Stage("search", run, whole=whole)


def _is_done(folder: CampaignFolder, key: tuple[str, int]) -> bool:
    """Return True if the file of a replica exists and is undamaged; a damaged replica is to be
    searched again, which gives the same bits.

    Args:
        folder: the results folder.
        key: name of the algorithm and number of the replica.
    """
    exists = replica_file(folder.root, *key).exists()
    objectives = folder.settings.objectives
    return is_whole(exists, lambda: read_replica(folder.root, *key, objectives))


def _replicas(folder: CampaignFolder) -> dict[tuple[str, int], Path]:
    """Return the file of every replica in a results folder.

    Returns:
        Path by algorithm name and replica number, ordered by replica number, so that every
        algorithm has results early.
    """
    settings = folder.settings
    return {
        (algorithm, replica): replica_file(folder.root, algorithm, replica)
        for replica in range(settings.replicas)
        for algorithm in settings.algorithms
    }
