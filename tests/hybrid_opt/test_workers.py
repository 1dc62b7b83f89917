"""Workers, in processes of this machine and on a Dask cluster: the same results, whatever dies or
is interrupted."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from hybrid_opt.campaign import CampaignSettings, ExecutionSettings
from hybrid_opt.cluster import DaskWorkers
from hybrid_opt.errors import WorkerError
from hybrid_opt.workers import MAX_DEATHS, LocalWorkers, Workers
from symbolic.errors import DualArmError, SettingsError
from tests.hybrid_opt import worker_calls as calls
from tests.hybrid_opt.campaign.fake import ROOT, FakeSource, files_of, run_search
from tests.refusals import refused
from tests.waiting import HANGS, until


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    dask = pytest.importorskip("dask")
    distributed = pytest.importorskip("distributed")
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 1}),
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
        ) as running,
    ):
        yield running


LOCAL = {"here": 1, "two": 2}
DASK = "dask"


@pytest.fixture
def workers(request: pytest.FixtureRequest) -> Iterator[Workers]:
    """The workers that a test is parametrised with: so many processes, or the cluster's."""
    if request.param == DASK:
        address = request.getfixturevalue("cluster").scheduler_address
        with DaskWorkers(address, calls.machine) as found:
            yield found
    else:
        with LocalWorkers(LOCAL[request.param]) as local:
            yield local


def on(*names: str) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("workers", names, indirect=True)


@on(*LOCAL, DASK)
def test_results_are_complete_in_order_and_reported_as_they_come(workers: Workers) -> None:
    told: dict[int, bytes] = {}
    for arguments in ([4, 3, 2, 1], []):
        told.clear()
        found = workers.map(calls.numbers, arguments, told.__setitem__)
        # Who works changes no bit.
        assert found == [calls.numbers(seed) for seed in arguments]
        assert [told[k] for k in range(len(arguments))] == found


@on(*LOCAL, DASK)
def test_errors_end_the_work_but_not_the_workers(workers: Workers) -> None:
    with pytest.raises(DualArmError, match="misused"):
        workers.map(calls.misuse, [1, 2, 3])
    with pytest.raises((OSError, RuntimeError), match="own-file"):
        workers.map(calls.mistake, [1, 2, 3])
    assert workers.map(calls.moody, ["a", "b"]) == ["a", "b"]


@on(*LOCAL, DASK)
def test_linear_algebra_has_one_thread_in_a_call(workers: Workers) -> None:
    before = calls.threads(None)
    for found in workers.map(calls.threads, [1, 2]):
        assert found
        assert set(found) == {1}
    assert calls.threads(None) == before


def test_several_calls_are_made_in_other_processes_and_one_here() -> None:
    with LocalWorkers(2) as workers:
        others = workers.map(calls.process, range(4))
        assert os.getpid() not in others
        assert workers.map(calls.process, [1]) == [os.getpid()]
        # The same processes serve every map.
        alive = {child.pid for child in multiprocessing.active_children()}
        assert set(others) <= alive
        assert set(workers.map(calls.process, range(4))) <= alive
    with LocalWorkers(1) as here:
        assert here.map(calls.process, [1, 2]) == [os.getpid()] * 2


def test_a_killed_worker_is_replaced_and_its_call_repeated(tmp_path: Path) -> None:
    files = [tmp_path / name for name in "abc"]
    files[1].touch()
    with LocalWorkers(2) as workers:
        assert workers.map(calls.killed_once, files) == ["alive"] * 3


def test_calls_that_keep_killing_workers_end_the_work() -> None:
    with (
        LocalWorkers(2) as workers,
        pytest.raises(WorkerError, match=rf" {MAX_DEATHS} .*__main__.* --resume"),
    ):
        workers.map(calls.moody, ["die", "die"])


def test_no_worker_is_left_behind() -> None:
    before = set(multiprocessing.active_children())
    with LocalWorkers(2) as workers:
        workers.map(calls.process, range(3))
        made = set(multiprocessing.active_children()) - before
        assert made
    until(lambda: not made & set(multiprocessing.active_children()))


PROGRAM = """
import sys
from hybrid_opt.workers import LocalWorkers, warm_up
from tests.hybrid_opt import worker_calls
warm_up("tests.hybrid_opt.worker_calls")
print("started", flush=True)
try:
    with LocalWorkers(2) as workers:
        workers.map(worker_calls.moody, ["hang", "hang"])
except KeyboardInterrupt:
    print("interrupted", flush=True)
"""


@pytest.mark.parametrize(
    "moment", [0.4, *(pytest.param(at, marks=pytest.mark.slow) for at in (0.0, 1.5))]
)
def test_ctrl_c_reaches_the_parent_alone(moment: float) -> None:
    process = started()
    time.sleep(moment)
    os.killpg(process.pid, signal.SIGINT)
    told, complaints = process.communicate(timeout=HANGS)
    assert told == "interrupted\n"
    assert complaints == ""
    wait_for_the_end_of_all(process.pid)


def test_workers_end_with_a_killed_parent() -> None:
    process = started()
    time.sleep(1.0)
    process.kill()
    process.communicate()
    wait_for_the_end_of_all(process.pid)


def started() -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "started\n"
    return process


def wait_for_the_end_of_all(group: int) -> None:
    def ended() -> bool:
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return True
        return False

    until(ended)


# --- a campaign on a cluster ---


SETTINGS = CampaignSettings(evaluations=160, replicas=2)


def test_a_killed_worker_of_a_cluster_changes_nothing(tmp_path: Path, cluster: Any) -> None:
    expected = files_of(run_search(SETTINGS, ExecutionSettings(tmp_path / "here", 1)))
    marker = tmp_path / "dead"
    source = FakeSource(delay=0.02, dies_at=120, dies_once=str(marker))
    address = cluster.scheduler_address
    there = ExecutionSettings(tmp_path / "there", executor="dask", scheduler=address)
    root = run_search(SETTINGS, there, source)
    assert marker.exists()
    assert files_of(root) == expected


def test_a_call_that_kills_a_clusters_workers_ends_the_work(cluster: Any) -> None:
    with (
        DaskWorkers(cluster.scheduler_address, calls.machine) as workers,
        refused(WorkerError, "cluster", "KilledWorker", "--resume"),
    ):
        workers.map(calls.moody, ["die"])


def other_machine() -> dict[str, str]:
    """Describe this process as one with other software than the workers'."""
    return {"numpy": f"{os.getpid()}"}


def test_workers_with_other_software_are_refused(cluster: Any) -> None:
    with (
        DaskWorkers(cluster.scheduler_address, other_machine) as workers,
        pytest.raises(DualArmError, match=rf"tcp.* numpy \d+, .* {os.getpid()}"),
    ):
        workers.map(calls.process, [1])


@pytest.mark.slow
def test_a_lost_scheduler_is_told(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("hybrid_opt.cluster.LOST_SECONDS", 0.5)
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=True, dashboard_address=None
    ) as own:
        end = threading.Timer(3.0, own.close)
        end.start()
        with (
            DaskWorkers(own.scheduler_address, calls.machine) as workers,
            refused(WorkerError, "cluster", "tcp", "--resume"),
        ):
            workers.map(calls.moody, ["hang"])
        end.join()
    # Of this process: what the worker's own log says of its scheduler is not ours to keep.
    assert not [record for record in caplog.records if record.exc_info]


@pytest.mark.parametrize(
    "address",
    ["", "foo://x", "tcp://", "tcp://[::1", ":::", "x" * 3000, "\udcff", "inproc://1/2/3"],
)
def test_other_addresses_are_refused(address: str) -> None:
    with (
        DaskWorkers(address, calls.machine) as nowhere,
        refused(SettingsError, "address") as caught,
    ):
        nowhere.map(calls.process, [1])
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 600


def test_no_scheduler_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hybrid_opt.cluster.CONNECT_SECONDS", 0.5)
    with (
        DaskWorkers("tcp://127.0.0.1:9", calls.machine) as nobody,
        refused(SettingsError, "no-scheduler", "tcp://127.0.0.1:9"),
    ):
        nobody.map(calls.process, [1])
