"""A stage that is a whole campaign of its own, in a folder inside that of the study."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from hybrid_opt.campaign.documents import CONFIGURATION, DRIVABLE
from hybrid_opt.campaign.folder import CampaignFolder, open_folder
from hybrid_opt.campaign.settings import CampaignSettings
from hybrid_opt.campaign.stages import Progress, Stage, run_stages
from hybrid_opt.evaluate.objectives import force_kind
from symbolic.read.cell_files import drivable_files, unpack_cell


def drivable_settings(settings: CampaignSettings) -> CampaignSettings:
    """Settings of the drivable experiment beside another one: the same but for the objectives,
    durations and forces of the kind that the other one minimises."""
    return replace(settings, objectives=force_kind(settings.objectives).drivable)


def drivable_stage(stages: Sequence[Stage]) -> Stage:
    """The stage that searches for carries as robots drive them, in the folder `drivable/`.

    The folder is a campaign like any other, of the drivable variant of the study's cell.

    Args:
        stages: of that campaign.
    """

    def run(folder: CampaignFolder, progress: Progress) -> None:
        root = folder.root / DRIVABLE
        resume = (root / CONFIGURATION).exists()
        execution = replace(folder.execution, output=root, resume=resume, overwrite=False)
        with TemporaryDirectory() as files:
            workcell = unpack_cell(drivable_files(folder.files), Path(files))
            settings = drivable_settings(folder.settings)
            with open_folder(settings, execution, workcell) as inner:
                run_stages(inner, stages, Progress(progress.shown, DRIVABLE))

    return Stage(DRIVABLE, run, {stage.name: dict(stage.settings) for stage in stages})
