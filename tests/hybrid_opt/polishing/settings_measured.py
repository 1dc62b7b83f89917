"""What one setting of the polish changes: hypervolume and core-seconds of the same searched fronts.

    python -m tests.hybrid_opt.polishing.settings_measured studies/workcells/transfer.toml

searches with NSGA-II and seeds 1, 2, ... and polishes each front with the defaults and with one
setting changed at a time. Everything runs in one process, so that its time is that of the polish.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

import hybrid_opt as ho
from hybrid_opt.display.table import text_table
from hybrid_opt.indicators.metrics import hypervolume, reference_point
from hybrid_opt.polishing.settings import PolishSettings

DEFAULT = PolishSettings()
CHANGED: dict[str, PolishSettings] = {
    "defaults": DEFAULT,
    "attempts 6": replace(DEFAULT, attempts=6),
    "attempts 24": replace(DEFAULT, attempts=24),
    "rounds 4": replace(DEFAULT, rounds=4),
    "rounds 12": replace(DEFAULT, rounds=12),
    "max_iterations 15": replace(DEFAULT, max_iterations=15),
    "solver ipopt": replace(DEFAULT, solver="ipopt"),
    "probe.rounds 3": replace(DEFAULT, probe=replace(DEFAULT.probe, rounds=3)),
    "fill.solved 24": replace(DEFAULT, fill=replace(DEFAULT.fill, solved=24)),
}


def measured(cell: ho.Cell, front: ho.Front, settings: PolishSettings) -> tuple[float, float]:
    """Hypervolume after the polish with seed 1, and its core-seconds."""
    start = time.process_time()
    polished = ho.polish(front, rng=np.random.default_rng(1), settings=settings)
    seconds = time.process_time() - start
    return hypervolume(polished.objectives, reference_point(2)), seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("workcell", type=Path)
    parser.add_argument("--fronts", type=int, default=3)
    options = parser.parse_args()
    cell = ho.Cell.load(options.workcell)
    fronts = [
        ho.search(cell, "nsga2", evaluations=1000, rng=np.random.default_rng(seed + 1))
        for seed in range(options.fronts)
    ]
    _ = cell.polish_functions  # built before anything is timed
    base = np.zeros(len(fronts))
    rows = [("setting", "hypervolume less the defaults' [1e-5]", "core-seconds")]
    for name, settings in CHANGED.items():
        found = np.array([measured(cell, front, settings) for front in fronts])
        if name == "defaults":
            base = found[:, 0]
            shown = ", ".join(f"{value:.5f}" for value in base)
        else:
            shown = ", ".join(f"{1e5 * value:+.0f}" for value in found[:, 0] - base)
        rows.append((name, shown, ", ".join(f"{value:.1f}" for value in found[:, 1])))
        print(name, shown, rows[-1][-1], flush=True)
    print(text_table(rows, left=(0, 1, 2)))


if __name__ == "__main__":
    main()
