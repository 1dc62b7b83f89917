"""What every reader promises, whatever the file: a value, or one error that says what is wrong."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from resource import RUSAGE_CHILDREN, RUSAGE_SELF, getrusage
from typing import Any

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from symbolic.errors import DualArmError

MOST_SECONDS = 20.0
LONGEST_MESSAGE = 40_000
"""A hundred problems of four hundred letters."""

_PRESSURE = Path("/proc/pressure/cpu")


Checks = Mapping[str, tuple[Callable[..., None], tuple[st.SearchStrategy[Any], ...]]]
"""What is damaged, and with what, by name."""

MANY = 1000
"""Damages of one kind in the long tests."""


def all_kept(checks: Checks, kind: str, examples: int) -> None:
    """Run one check with so many examples of its strategies."""
    check, strategies = checks[kind]
    limited = settings(max_examples=examples, suppress_health_check=list(HealthCheck))
    limited(given(*strategies)(check))()


def kept(read: Callable[[], Any], *names: str) -> Any:
    """What reading gave, or None where it was refused as promised.

    Args:
        read: reads the file; anything but a `DualArmError` goes through and fails the test.
        names: of the file, one of which a refusal has to contain.
    """
    with soon():
        try:
            return read()
        except DualArmError as error:
            said = str(error)
    assert any(name in said for name in names), said
    assert 0 < len(said) < LONGEST_MESSAGE, len(said)
    assert all(line.isprintable() for line in said.splitlines()), ascii(said)
    return None


@contextmanager
def soon() -> Iterator[None]:
    """Hold the `with` block to `MOST_SECONDS`, as they pass on a machine with nothing else to do.

    On a crowded one, what counts is the computing time of this process and of those it started
    and waited for, and the time that passed while no process of the machine waited for a core.
    """
    began, computed, waited = time.monotonic(), _computed(), _waited()
    yield
    passed = time.monotonic() - began
    if passed > MOST_SECONDS:
        assert _computed() - computed < MOST_SECONDS
        assert passed - (_waited() - waited) < MOST_SECONDS


def _computed() -> float:
    """Computing time so far [s]."""
    usages = getrusage(RUSAGE_SELF), getrusage(RUSAGE_CHILDREN)
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def _waited() -> float:
    """How long any process of the machine waited for a core so far [s]; 0 where none tells."""
    if not _PRESSURE.exists():
        return 0.0
    return int(_PRESSURE.read_text().splitlines()[0].rpartition("total=")[2]) * 1e-6
