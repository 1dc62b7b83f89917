"""Errors by their codes and what they quote: a sentence may be rewritten without a test."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from studies import program
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


@contextmanager
def ended_by(code: str, *quoted: object) -> Iterator[None]:
    """Expect a program that runs here to end with an error of this code that quotes this."""
    told: list[DualArmError] = []
    usual = program.carry_out

    def observed(name: str, work: Callable[[], int], *rest: str) -> int:
        def recorded() -> int:
            try:
                return work()
            except DualArmError as error:
                told.append(error)
                raise

        return usual(name, recorded, *rest)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(program, "carry_out", observed)
        patch.setattr("studies.run.carry_out", observed)
        yield
    (error,) = told
    assert error.code == code, error
    for value in quoted:
        assert str(value) in str(error)
