"""The same campaign on a Dask cluster, one of whose workers is killed."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hybrid_opt.campaign import CampaignSettings, ExecutionSettings
from hybrid_opt.errors import WorkerError
from hybrid_opt.work.dask_cluster import DaskExecutor
from hybrid_opt.work.service import KILLED, SILENT, Service
from symbolic.errors import DualArmError, SettingsError
from tests.hybrid_opt.campaign.fake import FakeSource, files_of, logged, run_search
from tests.hybrid_opt.work import services

dask = pytest.importorskip("dask")
distributed = pytest.importorskip("distributed")

SETTINGS = CampaignSettings(evaluations=160, replicas=3)


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 1}),
        distributed.LocalCluster(
            n_workers=3, threads_per_worker=1, processes=True, dashboard_address=None
        ) as running,
    ):
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


@pytest.mark.slow
def test_what_a_lost_campaign_recorded_is_not_repeated(tmp_path: Path, cluster: Any) -> None:
    settings = replace(SETTINGS, algorithms={"mopso": {}}, replicas=1)
    log = tmp_path / "log"
    with pytest.raises(WorkerError, match="--resume"):
        run_search(
            settings,
            on(cluster, tmp_path / "a"),
            FakeSource(delay=0.1, dies_beyond=80, log=str(log)),
        )
    log.unlink()
    run_search(settings, on(cluster, tmp_path / "a", resume=True), FakeSource(log=str(log)))
    expected = files_of(run_search(settings, ExecutionSettings(tmp_path / "here", 1)))
    assert files_of(tmp_path / "a") == expected
    assert len(logged(log)) == 160 - 80


def machine() -> dict[str, str]:
    return {"numpy": np.__version__}


def executor(cluster: Any, environment: dict[str, str] | None = None) -> DaskExecutor:
    return DaskExecutor(cluster.scheduler_address, environment or machine(), machine)


def test_messages_come_in_order_and_once(cluster: Any) -> None:
    found = services.run(executor(cluster), services.echo, [0, 1, 2, 3, 4])
    assert [answer[0] for answer in found.answers] == [0, 1, 2, 3, 4]
    # Answers may overtake messages, which then no longer matter; what comes is in order.
    for messages in found.messages.values():
        assert messages == [bytes([number]) for number in range(len(messages))]


def test_errors_arrive_as_they_are(cluster: Any) -> None:
    with pytest.raises(RuntimeError, match="OSError: a file of the request's own"):
        services.run(executor(cluster), services.mistake, [1])
    with pytest.raises(DualArmError, match="this cannot be done"):
        services.run(executor(cluster), services.misuse, [1])


def test_a_hung_request_is_given_up_and_no_other(cluster: Any) -> None:
    found = services.run(
        executor(cluster), services.moody, ["hang", "a"], patience=2.0, instead="instead"
    )
    assert found.answers == ["instead", "a"]
    assert found.losses == [(0, SILENT)]


def test_a_request_that_kills_its_workers_is_lost(cluster: Any) -> None:
    # Alone: Dask blames all that waits on a worker for its death.
    found = services.run(executor(cluster), services.moody, ["die"], instead="instead")
    assert found.answers == ["instead"]
    assert found.losses == [(0, KILLED)]


def test_workers_with_other_software_are_refused(cluster: Any) -> None:
    with pytest.raises(DualArmError, match=r"worker tcp.* has numpy .*, this campaign 1\.0"):
        services.run(executor(cluster, {"numpy": "1.0"}), services.echo, [1])


@pytest.mark.slow
def test_a_lost_scheduler_is_told(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("hybrid_opt.work.dask_cluster.LOST_SECONDS", 0.5)
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=True, dashboard_address=None
    ) as own:
        end = threading.Timer(3.0, own.close)
        end.start()
        with pytest.raises(WorkerError, match=r"scheduler at tcp.* not answer any more; .*--re"):
            services.run(executor(own), services.moody, ["hang"])
        end.join()
    # Of this process: what the worker's own log says of its scheduler is not ours to keep.
    assert not [record for record in caplog.records if record.exc_info]


@pytest.mark.parametrize(
    "address",
    ["", "foo://x", "tcp://", "tcp://[::1", ":::", "x" * 3000, "\udcff", "inproc://1/2/3"],
)
def test_other_addresses_are_refused(address: str) -> None:
    nowhere = DaskExecutor(address, machine(), machine)
    with pytest.raises(SettingsError, match="is no address of a Dask scheduler") as caught:
        nowhere.run(Service(services.context, services.echo), services.MessageLedger([1]))
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 600


def test_no_scheduler_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hybrid_opt.work.dask_cluster.CONNECT_SECONDS", 0.5)
    nobody = DaskExecutor("tcp://127.0.0.1:9", machine(), machine)
    with pytest.raises(SettingsError, match=r"no Dask scheduler answers at tcp://127.0.0.1:9"):
        nobody.run(Service(services.context, services.echo), services.MessageLedger([1]))
