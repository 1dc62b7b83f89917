"""What the page of a session asks for: the last of many changes counts."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

import hybrid_opt as ho
from hybrid_opt.workbench.browser import Workbench
from hybrid_opt.workbench.session import handles
from tests.hybrid_opt.cells import shipped
from tests.waiting import HANGS


@pytest.fixture(scope="module")
def bench() -> Iterator[Workbench]:
    page = ho.live(shipped("rack"), port=18080)
    yield page
    page.close()


def waited(holds: Callable[[], bool], what: str) -> None:
    end = time.monotonic() + HANGS
    while not holds():
        assert time.monotonic() < end, what
        time.sleep(0.02)


def test_dragging_never_queues_and_ends_where_it_was_let_go(bench: Workbench) -> None:
    (pallet,) = [one for one in handles(bench.session.cell.workcell) if "pallet" in one.key]
    for k in range(50):
        z = pallet.pose[2, 3] + 0.001 * k
        bench.ask({f"{pallet.key}.xyz": [*pallet.pose[:2, 3].tolist(), z]})
    end = pallet.pose[2, 3] + 0.049

    def there() -> bool:
        body = next(b for b in bench.session.cell.workcell.environment if b.name == pallet.title)
        return bool(abs(body.pose[2, 3] - end) < 1e-9)

    waited(there, "the last place")
    assert np.isfinite(bench.session.verdict.seconds)
