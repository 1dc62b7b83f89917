"""What every reader promises, whatever the file: a value, or one error that says what is wrong."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from symbolic.errors import DualArmError

MOST_SECONDS = 20.0
LONGEST_MESSAGE = 40_000
"""A hundred problems of four hundred letters."""


def kept(read: Callable[[], Any], *names: str) -> Any:
    """What reading gave, or None where it was refused as promised.

    Args:
        read: reads the file; anything but a `DualArmError` goes through and fails the test.
        names: of the file, one of which a refusal has to contain.
    """
    start = time.monotonic()
    try:
        found = read()
    except DualArmError as error:
        found = None
        said = str(error)
        assert any(name in said for name in names), said
        assert 0 < len(said) < LONGEST_MESSAGE, len(said)
        assert all(line.isprintable() for line in said.splitlines()), ascii(said)
    assert time.monotonic() - start < MOST_SECONDS
    return found
