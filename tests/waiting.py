"""Waiting for other processes, and limits of time, on a machine that may be crowded."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from resource import RUSAGE_CHILDREN, RUSAGE_SELF, getrusage
from typing import Any

HANGS = 900.0
"""What takes so long hangs [s], also beside ten other programs on each core."""

MOST_SECONDS = 20.0
"""For anything that is refused [s]."""

_PRESSURE = Path("/proc/pressure/cpu")


def until(condition: Callable[[], bool], *processes: subprocess.Popen[Any]) -> None:
    """Wait for what processes do, which have to live meanwhile."""
    end = time.monotonic() + HANGS
    while not condition():
        assert all(process.poll() is None for process in processes), "it ended before"
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


@contextmanager
def soon(seconds: float = MOST_SECONDS) -> Iterator[None]:
    """Hold the `with` block to so much time [s], as it passes on a machine with nothing else to do.

    On a crowded one, what counts is the computing time of this process and of those it started
    and waited for, and the time that passed while no process of the machine waited for a core.
    """
    began, computed, waited = time.monotonic(), _computed(), _waited()
    yield
    passed = time.monotonic() - began
    if passed > seconds:
        assert _computed() - computed < seconds
        assert passed - (_waited() - waited) < seconds


def _computed() -> float:
    """Computing time so far [s]."""
    usages = getrusage(RUSAGE_SELF), getrusage(RUSAGE_CHILDREN)
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def _waited() -> float:
    """How long any process of the machine waited for a core so far [s]; 0 where none tells."""
    if not _PRESSURE.exists():
        return 0.0
    return int(_PRESSURE.read_text().splitlines()[0].rpartition("total=")[2]) * 1e-6
