"""Workers are on their way before a program is imported, where it needs any here."""

from __future__ import annotations

import pytest

from studies import workers


@pytest.mark.parametrize(
    ("arguments", "started"),
    [
        (["--quick", "--output", "results"], True),
        (["--executor", "processes"], True),
        (["--help"], False),
        (["cell.toml", "-h"], False),
        (["--executor", "dask", "--scheduler", "tcp://here:8786"], False),
        (["--executor=dask"], False),
    ],
)
def test_workers_are_started_for_work_on_this_machine(
    arguments: list[str], started: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    loaded: list[tuple[str, ...]] = []
    monkeypatch.setattr(workers, "warm_up", lambda *modules: loaded.append(modules))
    workers.start_workers(arguments)
    assert loaded == ([workers.WORKERS_LOAD] if started else [])
