"""The stage of a study that polishes its fronts.

Fronts of both peak forces are polished replica by replica. Of drivable fronts only the union is
polished: a polish begins with the best of all known paths, so the polished fronts of two replicas
would share most of their points. The file of a front is its `PolishedFront` as JSON.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass

from hybrid_opt.campaign.folder import CampaignFolder
from hybrid_opt.campaign.results import is_whole, read_campaign, read_polished
from hybrid_opt.campaign.settings import CampaignSettings, polished_file
from hybrid_opt.campaign.stages import Stage, loaded_cell, store_results
from hybrid_opt.front import Front, polish
from hybrid_opt.polishing.settings import PolishSettings
from hybrid_opt.polishing.solvers.ipopt import use_one_thread
from hybrid_opt.progress import Progress, ShowProgress
from hybrid_opt.store.files import to_json
from symbolic.array import Array
from symbolic.read.cell_files import CellFiles


@dataclass(frozen=True)
class PolishRequest:
    """Request to polish one front; it can be sent to another process.

    Attributes:
        files: files of the campaign's cell.
        settings: settings of the campaign.
        polish: settings of the polish.
        algorithm: name of the algorithm that found the front.
        replica: number of the replica that found the front.
        x: (k, n_var) decision vectors of the front.
        paths: (m, n_path) further known paths from which the polish may start.
    """

    files: CellFiles
    settings: CampaignSettings
    polish: PolishSettings
    algorithm: str
    replica: int
    x: Array
    paths: tuple[Array, ...]


def polish_front(request: PolishRequest, progress: ShowProgress = False) -> bytes:
    """Polish one front and return the content of its file, a `PolishedFront` as JSON.

    Args:
        request: the front, with the settings and the cell.
        progress: True for a progress bar, or a function of the finished and the total number of
            attempts.
    """
    use_one_thread()
    settings = request.settings
    done = polish(
        Front.of(loaded_cell(request.files, settings.objectives), request.x),
        rng=settings.replica_rng(f"{request.algorithm}/polish", request.replica),
        settings=request.polish,
        paths=request.paths,
        progress=progress,
    )
    return json.dumps(to_json(done.polished), indent=1, allow_nan=False).encode()


def polish_stage(
    settings: PolishSettings, known: Callable[[CampaignFolder], Array] | None = None
) -> Stage:
    """Return the stage of a study that polishes the fronts of `CampaignResults.to_polish`.

    Args:
        settings: settings of the polish.
        known: function of the open results folder that returns further paths (m, n_path) from which
            the polish may start, such as those of another campaign; None for no further paths.
    """

    def run(folder: CampaignFolder, progress: Progress) -> None:
        fronts = read_campaign(folder.root).to_polish
        left = [front for front in fronts if not _is_polished(folder, front)]
        paths = tuple(known(folder)) if known is not None and left else ()
        requests = {
            polished_file(folder.root, *front.key): PolishRequest(
                folder.files, folder.settings, settings, *front.key, front.x, paths
            )
            for front in left
        }
        stage = ("polish", "attempts" if len(fronts) == 1 else "fronts", 1)
        store_results(folder, progress, stage, polish_front, requests, len(fronts) - len(left))

    def whole(folder: CampaignFolder) -> bool:
        # A front that cannot be read is the search's to compute anew.
        return all(_is_polished(folder, front) for front in read_campaign(folder.root).to_polish)

    return Stage("polish", run, asdict(settings), whole)


def _is_polished(folder: CampaignFolder, front: Front) -> bool:
    """Return True if the polished front of a front is stored in a results folder and undamaged.

    Args:
        folder: the results folder.
        front: the front before the polish.
    """
    exists = polished_file(folder.root, *front.key).exists()
    return is_whole(exists, lambda: read_polished(folder.root, front))
