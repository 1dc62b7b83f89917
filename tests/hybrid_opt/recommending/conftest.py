"""A small drivable front that the tests of the recommendation share."""

from __future__ import annotations

import numpy as np
import pytest

import hybrid_opt as ho
from tests.symbolic.read.samples import RACK


@pytest.fixture(scope="session")
def drivable() -> ho.Cell:
    """The rack under the time law 'optimal'."""
    return ho.Cell.load(RACK).drivable()


@pytest.fixture(scope="session")
def front(drivable: ho.Cell) -> ho.Front:
    """What a short search finds there."""
    return ho.search(drivable, "nsga2", evaluations=160, rng=np.random.default_rng(3))
