"""The same campaign on a Dask cluster, one of whose workers is killed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hybrid_opt.campaign import CampaignSettings, ExecutionSettings
from hybrid_opt.errors import WorkerError
from hybrid_opt.work.dask_executor import DaskExecutor
from hybrid_opt.work.executor import Emit, Job
from symbolic.errors import DualArmError, SettingsError
from tests.hybrid_opt.campaign.fake import FakeSource, files_of, logged, run_search

distributed = pytest.importorskip("distributed")

SETTINGS = CampaignSettings(evaluations=160, replicas=3)


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    with distributed.LocalCluster(
        n_workers=3, threads_per_worker=1, processes=True, dashboard_address=None
    ) as running:
        yield running


def on(cluster: Any, output: Path, resume: bool = False) -> ExecutionSettings:
    address = cluster.scheduler_address
    return ExecutionSettings(output, executor="dask", scheduler=address, resume=resume)


def test_a_killed_worker_changes_nothing(tmp_path: Path, cluster: Any) -> None:
    expected = files_of(run_search(SETTINGS, ExecutionSettings(tmp_path / "here", 1)))
    marker, log = tmp_path / "dead", tmp_path / "log"
    source = FakeSource(delay=0.02, dies_at=200, dies_once=str(marker), log=str(log))
    root = run_search(SETTINGS, on(cluster, tmp_path / "there"), source)
    assert marker.exists()
    assert files_of(root) == expected
    # Only what the killed worker had evaluated was done twice; it died in its sixth generation.
    repeated = len(logged(log)) - len(np.unique(logged(log), axis=0))
    assert 0 < repeated <= 6 * 40
    assert not list(root.glob("replicas/*/*/journal.bin"))


def test_what_a_lost_campaign_recorded_is_not_repeated(tmp_path: Path, cluster: Any) -> None:
    settings = replace(SETTINGS, algorithms=("mopso",), replicas=1)
    log = tmp_path / "log"
    with pytest.raises(WorkerError, match="--resume"):
        run_search(
            settings,
            on(cluster, tmp_path / "a"),
            FakeSource(delay=0.1, dies_at=80, always_dies=True, log=str(log)),
        )
    begun = len(logged(log))
    run_search(settings, on(cluster, tmp_path / "a", resume=True), FakeSource(log=str(log)))
    expected = files_of(run_search(settings, ExecutionSettings(tmp_path / "here", 1)))
    assert files_of(tmp_path / "a") == expected
    assert len(logged(log)) - begun < 160


def echo(context: str, task: int, emit: Emit) -> tuple[str, int]:
    for number in range(task):
        emit(bytes([task, number]))
    return context, task


def fail(context: str, task: int, emit: Emit) -> None:
    raise DualArmError(f"{context} {task} went wrong") if task else ValueError("unforeseen")


def context() -> str:
    return "context"


def machine() -> dict[str, str]:
    return {"numpy": np.__version__}


def run(cluster: Any, work: Any, environment: dict[str, str], count: int) -> Any:
    executor = DaskExecutor(cluster.scheduler_address, environment, machine)
    messages: list[bytes] = []
    results: dict[int, Any] = {}
    executor.run(
        Job(context, work),
        count,
        lambda index: index,
        lambda index, message: messages.append(message),
        results.__setitem__,
    )
    return messages, results


def test_messages_come_in_order_and_once(cluster: Any) -> None:
    messages, results = run(cluster, echo, machine(), 5)
    assert results == {index: ("context", index) for index in range(5)}
    # Results may overtake messages, which then no longer matter; what comes is in order.
    for task in range(5):
        mine = [message[1] for message in messages if message[0] == task]
        assert mine == list(range(len(mine)))


def test_errors_arrive_as_they_are(cluster: Any) -> None:
    with pytest.raises(RuntimeError, match="ValueError: unforeseen"):
        run(cluster, fail, machine(), 1)
    with pytest.raises(DualArmError, match="context 1 went wrong"):
        run(cluster, lambda c, t, e: fail(c, 1, e), machine(), 1)


def test_workers_with_other_software_are_refused(cluster: Any) -> None:
    with pytest.raises(DualArmError, match=r"worker tcp.* has numpy .*, this campaign 1\.0"):
        run(cluster, echo, {"numpy": "1.0"}, 1)


def test_no_scheduler_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hybrid_opt.work.dask_executor.CONNECT_SECONDS", 0.5)
    executor = DaskExecutor("tcp://127.0.0.1:9", machine(), machine)
    with pytest.raises(SettingsError, match=r"no Dask scheduler answers at tcp://127.0.0.1:9"):
        executor.run(Job(context, echo), 1, lambda i: i, lambda i, m: None, lambda i, r: None)
