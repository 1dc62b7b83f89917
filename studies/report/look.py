"""Animation and live view of the trajectories in a results folder."""

from __future__ import annotations

import sys
from pathlib import Path

from studies.report.animation import write_animation
from studies.report.data import gather_carries
from studies.report.live import LiveView


def animate(root: Path, path: Path) -> None:
    """Write the best selected trajectory of the first algorithm that has one.

    Raises:
        DualArmError: the results, the suffix or a library do not fit.
    """
    geometry, carries = gather_carries(root)
    write_animation(geometry, carries[min(1, len(carries) - 1)], path)


def watch(root: Path, port: int) -> None:
    """Show all selected trajectories until Ctrl-C.

    Raises:
        DualArmError: the results are incomplete or viser is missing.
    """
    view = LiveView(*gather_carries(root), port=port)
    address = f"http://{view.server.get_host()}:{view.server.get_port()}"
    print(f"Open {address} in a browser; Ctrl-C ends it.", file=sys.stderr)
    try:
        view.serve()
    except KeyboardInterrupt:
        view.stop()
