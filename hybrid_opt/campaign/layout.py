"""Where what lies in a results folder."""

from __future__ import annotations

from pathlib import Path

CONFIGURATION = "configuration.json"
SUMMARY = "summary.json"
WORKCELL = "workcell"
REPLICAS = "replicas"
STAGES = "stages"
FRONTS = "fronts"
SELECTED = "selected"

EVALUATIONS = "evaluations.csv.gz"
FRONT = "front.csv"
DONE = "replica.json"
JOURNAL = "journal.bin"


def replica_folder(root: Path, algorithm: str, replica: int) -> Path:
    """Folder of one replica, counted from 0."""
    return root / REPLICAS / algorithm / f"{replica:02d}"


def selected_file(root: Path, algorithm: str, replica: int) -> Path:
    """Trajectory file of the solution selected from one replica."""
    return root / SELECTED / algorithm / f"{replica:02d}.json"


def reference_front_file(root: Path) -> Path:
    """Non-dominated union of all fronts of the campaign."""
    return root / FRONTS / "reference.csv"
