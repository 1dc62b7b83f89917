"""A study that is struck in every stage, or whose cluster is, equals one left in peace.

Each folder is struck in every stage and before the first, in one of the ways a process dies: killed
outright, alone or with all it has started, interrupted from the keyboard, asked to end, or robbed
of a worker.
"""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.faults.kills import (
    BEGINNING,
    STAGES,
    contents,
    differences,
    ended,
    linger,
    running,
    session,
    started,
    strike,
    study,
    undisturbed,
    wait_for,
)
from tests.symbolic.cells import ROOT
from tests.waiting import until

FOLDERS = int(os.environ.get("STRUCK_FOLDERS", "1"))
"""Studies that are struck, each at other moments and in other ways."""

STRIKES = (BEGINNING, *sorted(2 * STAGES, key=STAGES.index))
"""Where one folder is struck, in the order in which a study gets there."""

WAYS = ("kill", "kill all", "interrupt", "terminate", "kill a worker")


@pytest.mark.slow
def test_a_study_struck_in_every_stage_is_the_same(tmp_path: Path) -> None:
    expected, took = undisturbed(tmp_path / "peace", report=True)
    for number in range(FOLDERS):
        rng, hits = random.Random(7 + number), 0
        output, said = tmp_path / f"struck-{number}", tmp_path / "said"

        def start(output: Path = output, said: Path = said) -> subprocess.Popen[bytes]:
            return started(study(output, output.exists(), report=True), said)

        process = start()
        for stage in STRIKES:
            if process.poll() is not None:
                ended(process, said)
                process = start()
            if stage != BEGINNING:
                wait_for(stage, output, process)
            # A stage that was resumed has less to do than it had at first.
            linger(rng.uniform(0.0, 0.7 * took[stage]), stage, output, process)
            if process.poll() is None:
                way = rng.choice(WAYS)
                hits += 1
                strike(process, way, rng)
                if way != "kill a worker":  # a study goes on without one
                    ended(process, said)
        ended(process, said)
        assert ended(start(), said) == 0, said.read_text()
        assert differences(expected, contents(output)) == []
        assert hits >= len(STAGES)


STRUCK = ("search", "polish", "timing")
"""Stages that work on the cluster."""


@dataclass(frozen=True)
class Cluster:
    """A scheduler with its address, and workers, each a nanny that starts it again."""

    address: str
    scheduler: subprocess.Popen[bytes]
    workers: tuple[subprocess.Popen[bytes], ...]

    def kill_a_worker(self, rng: random.Random) -> None:
        """Kill the process that does a worker's work; its nanny lives."""
        os.kill(rng.choice([one for nanny in self.workers for one in _work_of(nanny)]), 9)


def _work_of(nanny: subprocess.Popen[bytes]) -> list[int]:
    """A worker's own processes; beside them there is one that only waits for their end."""
    return [
        one
        for one in session(nanny.pid)
        if b"resource_tracker" not in Path(f"/proc/{one}/cmdline").read_bytes()
    ]


@contextmanager
def cluster(folder: Path, name: str) -> Iterator[Cluster]:
    """A cluster of two workers of one thread each, on this machine."""
    file = folder / f"{name}.json"
    quiet = ["--no-dashboard"]
    where = ["--host", "127.0.0.1", "--port", "0", "--scheduler-file", str(file)]
    each = ["--nworkers", "1", "--nthreads", "1", "--local-directory", str(folder / name)]
    with ExitStack() as stack:
        scheduler = stack.enter_context(_process(folder, "scheduler", [*quiet, *where]))
        until(lambda: file.exists() and bool(file.read_text().strip()), scheduler)
        address = str(json.loads(file.read_text())["address"])
        workers = tuple(
            stack.enter_context(_process(folder, "worker", [address, *quiet, *each]))
            for _ in range(2)
        )
        yield Cluster(address, scheduler, workers)


@contextmanager
def _process(folder: Path, role: str, options: list[str]) -> Iterator[subprocess.Popen[bytes]]:
    """A process of a cluster, ended with all that it started."""
    command = [sys.executable, "-m", f"distributed.cli.dask_{role}", *options]
    with (folder / f"{role}.log").open("ab") as log:
        process = subprocess.Popen(
            command,
            cwd=ROOT,
            env=os.environ | {"PYTHONPATH": str(ROOT)},
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            start_new_session=True,
        )
        try:
            yield process
        finally:
            for one in [process.pid, *session(process.pid)]:
                with suppress(ProcessLookupError):
                    os.kill(one, signal.SIGKILL)
            process.wait()


@pytest.mark.slow
def test_a_study_whose_cluster_dies_in_every_stage_is_the_same(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    rng = random.Random(11)
    expected, took = undisturbed(tmp_path / "peace", report=False)
    output, said = tmp_path / "struck" / "results", tmp_path / "said"

    def start(cluster: Cluster) -> subprocess.Popen[bytes]:
        command = study(output, output.exists(), report=False)
        return started([*command, "--executor", "dask", "--scheduler", cluster.address], said)

    for stage in STRUCK:
        with cluster(tmp_path, stage) as running_cluster:
            process = start(running_cluster)
            wait_for(stage, output, process)
            linger(rng.uniform(0.0, 0.3 * took[stage]), stage, output, process)
            assert running(output) == stage
            running_cluster.kill_a_worker(rng)
            linger(rng.uniform(0.0, 0.3 * took[stage]), stage, output, process)
            assert running(output) == stage
            running_cluster.scheduler.kill()
            code = ended(process, said)
            assert code == 2, said.read_text()
            assert "continue with --resume" in said.read_text()
    with cluster(tmp_path, "last") as whole:
        process = start(whole)
        assert ended(process, said) == 0, said.read_text()
    assert differences(expected, contents(output)) == []
