"""Paths in a results folder."""

from __future__ import annotations

from pathlib import Path

CONFIGURATION = "configuration.json"
SUMMARY = "summary.json"
BRANCHES = "branches.json"
WORKCELL = "workcell"
REPLICAS = "replicas"
STAGES = "stages"
FRONTS = "fronts"
SELECTED = "selected"
POLISHED = "polished"
POLISHED_SUFFIX = "-polished"
DRIVABLE = "drivable"
RECOMMENDED = "recommended.json"
RECOMMENDATION = "recommendation.json"
NO_RECOMMENDATION = "no-recommendation.json"
SIMULATED = "simulated"
HAND_MADE = "hand-made.json"

EVALUATIONS = "evaluations.csv.gz"
FRONT = "front.csv"
DONE = "replica.json"
JOURNAL = "journal.bin"
POLISH = "polish.json"


def replica_folder(root: Path, algorithm: str, replica: int) -> Path:
    """Folder of one replica, counted from 0."""
    return root / REPLICAS / algorithm / f"{replica:02d}"


def selected_file(root: Path, algorithm: str, replica: int) -> Path:
    """Trajectory file of the solution selected from one replica."""
    return root / SELECTED / algorithm / f"{replica:02d}.json"


def polished_folder(root: Path, algorithm: str, replica: int) -> Path:
    """Folder of what the polish made of one replica's front."""
    return root / POLISHED / algorithm / f"{replica:02d}"


def polished_selected_file(root: Path, algorithm: str, replica: int) -> Path:
    """Trajectory file of the solution selected from a replica's polished front."""
    return root / SELECTED / f"{algorithm}{POLISHED_SUFFIX}" / f"{replica:02d}.json"


def reference_front_file(root: Path) -> Path:
    """Non-dominated union of all fronts of the campaign."""
    return root / FRONTS / "reference.csv"
