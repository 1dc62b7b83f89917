"""What reading one file takes, in a process of its own: `-m tests.fuzz.reading FILE`."""

from __future__ import annotations

import json
import os
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from codegen.cache import Cache
from hybrid_opt.campaign.candidates import decode
from hybrid_opt.campaign.results import read_configuration
from hybrid_opt.polishing.front import PolishedFront
from hybrid_opt.store.bundle_file import read_manifest
from hybrid_opt.store.files import read_bytes, read_record
from hybrid_opt.store.trajectory_file import read_trajectory
from studies.research.best_front import read_reference_front
from symbolic.errors import DualArmError
from symbolic.read.cell import load
from symbolic.read.meshes import FORMATS, read_mesh
from symbolic.read.urdf import read_srdf, read_urdf

READERS: dict[str, Callable[[Path], Any]] = {
    "cell.toml": load,
    **dict.fromkeys(("arm.urdf", "arm.xacro"), read_urdf),
    "arm.srdf": read_srdf,
    **dict.fromkeys([f"m.{kind}" for kind in FORMATS], lambda path: read_mesh(path, np.ones(3))),
    "trajectory.json": read_trajectory,
    "configuration.json": lambda path: read_configuration(path.parent),
    "polish.json": lambda path: read_record(PolishedFront, path, ""),
    "candidates.csv.gz": lambda path: decode(read_bytes(path), path),
    "manifest.json": lambda path: read_manifest(path.parent),
    "front.csv": read_reference_front,
    "key.json": lambda path: Cache(path.parent).find(path.stem),
}
"""What reads a file, by its name."""


def main() -> None:
    """Read the file and tell, as JSON, what it took."""
    path = Path(sys.argv[1])
    warnings.simplefilter("ignore")
    # The peak that a process is born with is that of its parent.
    Path("/proc/self/clear_refs").write_text("5")
    before = _status("VmRSS")
    told = ""
    try:
        READERS[path.name](path)
    except DualArmError as error:
        told = str(error)
    times = os.times()
    grown = _status("VmHWM") - before
    print(json.dumps({"grown": grown, "seconds": sum(times[:4]), "told": told[:1000]}))


def _status(key: str) -> int:
    """A size of this process [bytes]."""
    lines = Path("/proc/self/status").read_text().splitlines()
    (line,) = (line for line in lines if line.startswith(f"{key}:"))
    return int(line.split()[1]) * 1024


if __name__ == "__main__":
    main()
