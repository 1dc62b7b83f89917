"""Campaigns: several replicas of every algorithm with equal budgets, stored in a results folder."""

from hybrid_opt.campaign.folder import CampaignFolder, ExecutionSettings, open_folder, workers_for
from hybrid_opt.campaign.search_stage import search_stage
from hybrid_opt.campaign.settings import CampaignSettings
from hybrid_opt.campaign.stages import Stage, check_stages, run_stages

__all__ = [
    "CampaignFolder",
    "CampaignSettings",
    "ExecutionSettings",
    "Stage",
    "check_stages",
    "open_folder",
    "run_stages",
    "search_stage",
    "workers_for",
]
