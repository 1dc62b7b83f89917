"""Executors, in processes of this machine and on a Dask cluster: the same answers, whatever dies,
hangs or is interrupted."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_info

from hybrid_opt.campaign import CampaignSettings, ExecutionSettings
from hybrid_opt.errors import WorkerError
from hybrid_opt.work.dask_cluster import DaskExecutor
from hybrid_opt.work.service import (
    KILLED,
    MAX_DEATHS,
    SILENT,
    Executor,
    LocalExecutor,
    Service,
    answer_all,
    give_up,
)
from symbolic.errors import DualArmError, SettingsError
from tests.hybrid_opt.campaign.fake import ROOT, FakeSource, files_of, logged, run_search
from tests.hybrid_opt.work import services
from tests.hybrid_opt.work.services import MessageLedger, run
from tests.waiting import HANGS, soon, until


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    dask = pytest.importorskip("dask")
    distributed = pytest.importorskip("distributed")
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 1}),
        distributed.LocalCluster(
            n_workers=3, threads_per_worker=1, processes=True, dashboard_address=None
        ) as running,
    ):
        yield running


LOCAL: dict[str, Executor] = {
    "here": LocalExecutor(),
    "apart": LocalExecutor(2, apart=True),
    "three": LocalExecutor(3),
}
DASK = "dask"


@pytest.fixture
def executor(request: pytest.FixtureRequest) -> Executor:
    """The executor that a test is parametrised with: one of `LOCAL`, or the cluster's."""
    if request.param == DASK:
        address = request.getfixturevalue("cluster").scheduler_address
        return DaskExecutor(address, services.machine(), services.machine)
    return LOCAL[request.param]


def on(*names: str) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("executor", names, indirect=True)


@on(*LOCAL, DASK)
def test_messages_in_order_and_answers_complete(executor: Executor) -> None:
    found = run(executor, services.echo, [3, 0, 5, 1, 2])
    assert [answer[0] for answer in found.answers] == [3, 0, 5, 1, 2]
    for index, count in enumerate([3, 0, 5, 1, 2]):
        messages = found.messages[index]
        # Of a cluster answers may overtake messages, which then no longer matter.
        assert len(messages) == count or isinstance(executor, DaskExecutor)
        assert messages == [bytes([number]) for number in range(len(messages))]
    # A context serves several requests.
    assert max(answer[1] for answer in found.answers) > 1


@on(*LOCAL, DASK)
def test_no_requests_no_work(executor: Executor) -> None:
    assert run(executor, services.echo, []).answers == []


@on(*LOCAL, DASK)
def test_errors_end_the_work(executor: Executor) -> None:
    with pytest.raises(DualArmError, match="this cannot be done"):
        run(executor, services.misuse, [1, 2, 3])
    with pytest.raises((OSError, RuntimeError), match="a file of the request's own is missing"):
        run(executor, services.mistake, [1, 2, 3])


def test_who_works_changes_no_bit() -> None:
    first, *others = [run(each, services.numbers, [1, 2, 3, 4, 5]) for each in LOCAL.values()]
    for other in others:
        assert other.answers == first.answers
        assert other.messages == first.messages


@on("here", "apart", DASK)
def test_a_hung_request_is_given_up_and_no_other(executor: Executor) -> None:
    # Dask's own messages take longer.
    patience = 2.0 if isinstance(executor, DaskExecutor) else 0.3
    with soon():
        found = run(executor, services.moody, ["hang", "a"], patience, instead="instead")
    assert found.answers == ["instead", "a"]
    assert found.losses == [(0, SILENT)]


@on("apart", DASK)
def test_a_request_that_kills_its_workers_is_lost(executor: Executor) -> None:
    # On a cluster alone: Dask blames all that waits on a worker for its death.
    others = [] if isinstance(executor, DaskExecutor) else ["a", "b", "c"]
    found = run(executor, services.moody, ["die", *others], instead="instead")
    assert found.answers == ["instead", *others]
    assert found.losses == [(0, KILLED)]


def test_a_list_is_answered_in_order_and_every_answer_told() -> None:
    told: dict[int, Any] = {}
    service = Service(services.context, services.echo)
    answers = answer_all(LocalExecutor(3, apart=True), service, [4, 3, 2, 1], told.__setitem__)
    assert [answer[0] for answer in answers] == [4, 3, 2, 1]
    assert [told[k] for k in range(4)] == answers
    moody = Service(services.context, services.moody)
    with pytest.raises(WorkerError, match="died 3 times"):
        answer_all(LocalExecutor(2, apart=True), moody, ["die", "a"])


@pytest.mark.parametrize(
    ("reason", "text"),
    [(KILLED, "died 3 times over one task .*__main__.* --resume"), (SILENT, "too long")],
)
def test_what_is_lost_is_told(reason: str, text: str) -> None:
    with pytest.raises(WorkerError, match=text):
        give_up(reason)


def threads() -> list[int]:
    """Of every linear algebra library that is loaded."""
    np.linalg.norm(np.eye(2))
    return [int(found["num_threads"]) for found in threadpool_info() if found["user_api"] == "blas"]


def test_a_request_is_answered_in_one_thread_and_the_others_return() -> None:
    before = threads()
    assert before
    service: Service[None, None, list[int]] = Service(
        lambda: None, lambda context, request, emit: threads()
    )
    assert service.answer(None, None, lambda message: None) == [1] * len(before)
    assert threads() == before


def test_a_killed_worker_is_replaced_and_its_request_repeated(tmp_path: Path) -> None:
    requests = [tmp_path / "a", tmp_path / "b"]
    requests[1].touch()
    found = run(LocalExecutor(2, apart=True), services.killed_once, requests)
    assert found.answers == ["alive", "alive"]
    assert found.messages == {0: [b"begun", b"begun"], 1: [b"begun"]}
    assert found.losses == []


def test_deaths_with_progress_in_between_lose_nothing() -> None:
    class Progressing(MessageLedger):
        def request(self, index: int) -> Any:
            return len(self.messages[index])

    ledger = Progressing([None])
    LocalExecutor(1, apart=True).run(
        Service(services.context, services.killed_step_by_step), ledger
    )
    assert ledger.answers == [5] > [MAX_DEATHS]
    assert ledger.losses == []


def test_only_what_must_be_given_up_needs_a_process_of_its_own() -> None:
    assert run(LocalExecutor(1), services.process, [1, 2]).answers == [os.getpid()] * 2
    assert run(LocalExecutor(8), services.process, [1]).answers == [os.getpid()]
    assert os.getpid() not in run(LocalExecutor(1), services.process, [1], patience=60.0).answers
    assert run(LocalExecutor(0), services.process, [1]).answers == [os.getpid()]
    assert os.getpid() not in run(LocalExecutor(1, apart=True), services.process, [1]).answers


def test_no_worker_is_left_behind() -> None:
    run(LocalExecutor(2, apart=True), services.echo, [1, 2, 3])
    assert not [child for child in multiprocessing.active_children() if child.name == "worker"]


PROGRAM = """
import sys, time
from hybrid_opt.work.service import Service
from hybrid_opt.work.service import LocalExecutor, warm_up
from tests.hybrid_opt.work import services
warm_up("tests.hybrid_opt.work.services")
ledger = services.MessageLedger(["hang", "hang"])
print("started", flush=True)
try:
    LocalExecutor(2, apart=True).run(Service(services.context, services.moody), ledger)
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


def there(cluster: Any, output: Path, resume: bool = False) -> ExecutionSettings:
    address = cluster.scheduler_address
    return ExecutionSettings(output, executor="dask", scheduler=address, resume=resume)


def test_a_killed_worker_changes_nothing(tmp_path: Path, cluster: Any) -> None:
    expected = files_of(run_search(SETTINGS, ExecutionSettings(tmp_path / "here", 1)))
    marker, log = tmp_path / "dead", tmp_path / "log"
    source = FakeSource(delay=0.02, dies_at=120, dies_once=str(marker), log=str(log))
    root = run_search(SETTINGS, there(cluster, tmp_path / "there"), source)
    assert marker.exists()
    assert files_of(root) == expected
    # Only what the killed worker had evaluated was done twice; it died in its fourth generation.
    repeated = len(logged(log)) - len(np.unique(logged(log), axis=0))
    assert 0 < repeated <= 4 * 40
    assert not list(root.glob("replicas/*/*/journal.bin"))


@pytest.mark.slow
def test_what_a_lost_campaign_recorded_is_not_repeated(tmp_path: Path, cluster: Any) -> None:
    settings = replace(SETTINGS, algorithms={"mopso": {}}, replicas=1)
    log = tmp_path / "log"
    with pytest.raises(WorkerError, match="--resume"):
        run_search(
            settings,
            there(cluster, tmp_path / "a"),
            FakeSource(delay=0.1, dies_beyond=80, log=str(log)),
        )
    log.unlink()
    run_search(settings, there(cluster, tmp_path / "a", resume=True), FakeSource(log=str(log)))
    expected = files_of(run_search(settings, ExecutionSettings(tmp_path / "here", 1)))
    assert files_of(tmp_path / "a") == expected
    assert len(logged(log)) == 160 - 80


def test_workers_with_other_software_are_refused(cluster: Any) -> None:
    with pytest.raises(DualArmError, match=r"worker tcp.* has numpy .*, this campaign 1\.0"):
        run(
            DaskExecutor(cluster.scheduler_address, {"numpy": "1.0"}, services.machine),
            services.echo,
            [1],
        )


@pytest.mark.slow
def test_a_lost_scheduler_is_told(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("hybrid_opt.work.dask_cluster.LOST_SECONDS", 0.5)
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=True, dashboard_address=None
    ) as own:
        end = threading.Timer(3.0, own.close)
        end.start()
        executor = DaskExecutor(own.scheduler_address, services.machine(), services.machine)
        with pytest.raises(WorkerError, match=r"scheduler at tcp.* not answer any more; .*--re"):
            run(executor, services.moody, ["hang"])
        end.join()
    # Of this process: what the worker's own log says of its scheduler is not ours to keep.
    assert not [record for record in caplog.records if record.exc_info]


@pytest.mark.parametrize(
    "address",
    ["", "foo://x", "tcp://", "tcp://[::1", ":::", "x" * 3000, "\udcff", "inproc://1/2/3"],
)
def test_other_addresses_are_refused(address: str) -> None:
    nowhere = DaskExecutor(address, services.machine(), services.machine)
    with pytest.raises(SettingsError, match="is no address of a Dask scheduler") as caught:
        nowhere.run(Service(services.context, services.echo), MessageLedger([1]))
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 600


def test_no_scheduler_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hybrid_opt.work.dask_cluster.CONNECT_SECONDS", 0.5)
    nobody = DaskExecutor("tcp://127.0.0.1:9", services.machine(), services.machine)
    with pytest.raises(SettingsError, match=r"no Dask scheduler answers at tcp://127.0.0.1:9"):
        nobody.run(Service(services.context, services.echo), MessageLedger([1]))
