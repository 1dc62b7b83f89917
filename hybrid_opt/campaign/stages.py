"""The steps of a study, each carried out once and then remembered as done.

A stage reads what earlier stages left in the results folder and writes files of its own. Its
marker, `stages/NAME.json`, is written when it begins and again when it is done. If a marker is
missing or says 'running', the stage runs (again), so a stage that takes long keeps what it
achieved in files of its own and continues from them. When a stage runs, all later ones do too.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from hybrid_opt.campaign.files import read_json, write_json
from hybrid_opt.campaign.folder import CampaignFolder
from hybrid_opt.campaign.layout import STAGES
from hybrid_opt.campaign.progress import Progress
from symbolic.errors import ResultsError


@dataclass(frozen=True)
class Stage:
    """One step of a study.

    Attributes:
        name: unique; names its marker.
        run: does it.
        settings: what decides its results besides the campaign, as JSON values.
    """

    name: str
    run: Callable[[CampaignFolder, Progress], None]
    settings: Mapping[str, Any] = field(default_factory=dict)


def run_stages(folder: CampaignFolder, stages: Sequence[Stage], progress: Progress) -> None:
    """Run the stages that are not done yet, in order.

    Raises:
        ResultsError: a stage began with other settings.
        DualArmError: what a stage raises.
    """
    stale = False
    for stage in stages:
        path = folder.root / STAGES / f"{stage.name}.json"
        marker = read_json(path) if path.exists() else {}
        if not isinstance(marker, dict):
            raise ResultsError(f"{path}: damaged; delete it to run the stage again")
        settings = dict(stage.settings)
        if marker and marker.get("settings") != settings:
            raise ResultsError(
                f"{folder.root}: the stage '{stage.name}' was run with {marker.get('settings')}, "
                f"now asked for is {settings}; choose another --output"
            )
        if marker.get("status") == "done" and not stale:
            continue
        stale = True
        spent = float(marker.get("seconds", 0.0)) if marker.get("status") == "running" else 0.0
        write_json(path, {"status": "running", "settings": settings, "seconds": spent})
        begin = time.perf_counter()
        try:
            stage.run(folder, progress)
        except BaseException:
            spent += time.perf_counter() - begin
            write_json(path, {"status": "running", "settings": settings, "seconds": spent})
            raise
        spent += time.perf_counter() - begin
        write_json(path, {"status": "done", "settings": settings, "seconds": spent})
