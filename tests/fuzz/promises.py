"""What every reader promises, whatever the file: a value, or one error that says what is wrong."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from symbolic.errors import DualArmError
from tests.waiting import soon

LONGEST_MESSAGE = 40_000
"""A hundred problems of four hundred letters."""


Checks = Mapping[str, tuple[Callable[..., None], tuple[st.SearchStrategy[Any], ...]]]
"""What is damaged, and with what, by name."""

MANY = 1000
"""Damages of one kind in the long tests."""


def all_kept(checks: Checks, kind: str, examples: int, *fixed: Any) -> None:
    """Run one check with so many examples of its strategies, behind arguments that are fixed."""
    check, strategies = checks[kind]

    def run(damage: tuple[Any, ...]) -> None:
        check(*fixed, *damage)

    limited = settings(max_examples=examples, suppress_health_check=list(HealthCheck))
    limited(given(st.tuples(*strategies))(run))()


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
