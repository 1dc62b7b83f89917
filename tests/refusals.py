"""Errors by their codes and what they quote: a sentence may be rewritten without a test."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from symbolic.errors import DualArmError


@contextmanager
def refused(
    kind: type[DualArmError], code: str, *quoted: object
) -> Iterator[pytest.ExceptionInfo[DualArmError]]:
    """Expect an error of this kind and code that quotes names, keys, numbers or commands."""
    with pytest.raises(kind) as told:
        yield told
    assert told.value.code == code, told.value
    for value in quoted:
        assert str(value) in str(told.value)
