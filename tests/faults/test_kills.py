"""A study that is struck in every stage, or whose cluster is, equals one left in peace.

Each folder is struck in every stage and before the first, in one of the ways a process dies: killed
outright, alone or with all it has started, interrupted from the keyboard, asked to end, or robbed
of a worker.
"""

from __future__ import annotations

import gzip
import itertools
import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from tests.symbolic.cells import ROOT
from tests.waiting import until

CELL = ROOT / "studies" / "workcells" / "transfer.toml"
SMALL = (
    *("--evaluations", "60", "--replicas", "2", "--polish-attempts", "1", "--seed", "3"),
    *("--population", "nsga2=20", "--population", "mopso=20", "--jobs", "2"),
)
STAGES = ("search", "polish", "drivable", "recommendation", "summary", "timing", "report")
BEGINNING = "beginning"
"""Before the first stage: the cell is read and its functions are compiled or loaded."""

TIMES = {
    "seconds",
    "evaluation_seconds",
    "median_attempt_seconds",
    "equivalent_evaluations",
}
"""Figures that are times, or follow from them."""

ENDS = {0, 2, 130, -signal.SIGINT, -signal.SIGKILL, -signal.SIGTERM}
PATIENCE = 300.0
ORPHANS_END = 60.0
"""So many seconds [s] after its parent's death a worker may still be there."""


def study(output: Path, resume: bool, report: bool) -> list[str]:
    """The command of a study."""
    options = ["--resume"] if resume else []
    options += ["--report" if report else "--no-report"]
    where = ["--quiet", "--output", str(output)]
    return [sys.executable, "-m", "studies.run", str(CELL), *SMALL, *where, *options]


def started(command: list[str], said: Path) -> subprocess.Popen[bytes]:
    """A program in a session of its own, so that all it starts can be found."""
    with said.open("wb") as messages:
        return subprocess.Popen(
            command,
            cwd=ROOT,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=messages,
            start_new_session=True,
        )


def session(leader: int) -> list[int]:
    """The living processes of a session, other than its leader."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal() and int(entry.name) != leader:
            try:
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            if int(fields[3]) == leader and fields[0] != "Z":
                found.append(int(entry.name))
    return found


def strike(process: subprocess.Popen[bytes], way: str, rng: random.Random) -> None:
    """Let a program die in this way, or lose a worker where it has any."""
    others, number = session(process.pid), signal.SIGKILL
    struck = [process.pid, *others]
    match way:
        case "kill":
            struck = [process.pid]
        case "interrupt":  # as a terminal does it: all of the foreground hear it
            number = signal.SIGINT
        case "terminate":
            struck, number = [process.pid], signal.SIGTERM
        case "kill a worker":
            struck = rng.sample(others, min(1, len(others)))
    for one in struck:
        with suppress(ProcessLookupError):
            os.kill(one, number)


def ended(process: subprocess.Popen[bytes], said: Path) -> int:
    """Wait for a program's end and hold it to its promises; the exit code."""
    code = process.wait(timeout=PATIENCE)
    words = said.read_text(errors="replace")
    assert code in ENDS, f"exit code {code}, said:\n{words[-4000:]}"
    assert "Traceback" not in words, words[-4000:]
    assert words.strip() or code not in (2, 130, -signal.SIGINT), f"exit code {code}, no message"
    begin = time.monotonic()
    while session(process.pid):
        assert time.monotonic() - begin < ORPHANS_END, "workers outlive their program"
        time.sleep(0.1)
    return code


def running(output: Path) -> str:
    """The stage that a study is at."""
    return next((stage for stage in STAGES if _status(output, stage) == "running"), "between")


def _status(output: Path, stage: str) -> str:
    with suppress(OSError, ValueError, KeyError):
        return str(json.loads((output / "stages" / f"{stage}.json").read_text())["status"])
    return ""


def wait_for(stage: str, output: Path, process: subprocess.Popen[bytes]) -> None:
    """Wait until a stage is running or done, or the program has ended."""
    while process.poll() is None and _status(output, stage) not in ("running", "done"):
        time.sleep(0.01)


def linger(seconds: float, stage: str, output: Path, process: subprocess.Popen[bytes]) -> None:
    """Let a stage run for a while, but neither into the next one nor to the program's end."""
    end = time.monotonic() + seconds
    while time.monotonic() < end and process.poll() is None and _status(output, stage) != "done":
        time.sleep(0.005)


def contents(root: Path) -> dict[str, Any]:
    """Every file of a results folder; of JSON the values and of candidates the lines, without
    times."""
    found: dict[str, Any] = {}
    for path in sorted(root.rglob("*")):
        name = path.relative_to(root).as_posix()
        if path.is_file() and not any(part.startswith(".") for part in name.split("/")):
            content = path.read_bytes()
            if path.suffix == ".gz":
                content = gzip.decompress(content).partition(b"\n")[2]
            found[name] = _timeless(json.loads(content)) if path.suffix == ".json" else content
    return found


def _timeless(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _timeless(inner) for key, inner in value.items() if key not in TIMES}
    return [_timeless(inner) for inner in value] if isinstance(value, list) else value


def differences(first: dict[str, Any], second: dict[str, Any]) -> list[str]:
    """Names of files that are missing on one side or differ."""
    return sorted(
        name for name in first.keys() | second.keys() if first.get(name) != second.get(name)
    )


def undisturbed(folder: Path, report: bool) -> tuple[dict[str, Any], dict[str, float]]:
    """The contents of a study left in peace, and what its stages took [s]."""
    folder.mkdir()
    output, said = folder / "results", folder / "said"
    assert ended(started(study(output, False, report), said), said) == 0, said.read_text()
    stages = [path for stage in STAGES if (path := output / "stages" / f"{stage}.json").exists()]
    took = {path.stem: float(json.loads(path.read_text())["seconds"]) for path in stages}
    return contents(output), took | {BEGINNING: took["search"]}


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


KILLS = 20


@pytest.mark.slow
def test_a_study_killed_twenty_times_at_random_moments_is_the_same(tmp_path: Path) -> None:
    """Moments are drawn over half of what a whole study takes, so that most runs are killed and
    some come to their end; then another folder begins."""
    begin = time.monotonic()
    expected, _ = undisturbed(tmp_path / "peace", report=False)
    longest, rng, said = (time.monotonic() - begin) / 2.0, random.Random(20), tmp_path / "said"
    kills = 0
    for number in itertools.count():
        output, code = tmp_path / f"killed-{number}", -1
        while code != 0:
            process = started(study(output, output.exists(), report=False), said)
            with suppress(subprocess.TimeoutExpired):
                process.wait(timeout=rng.uniform(0.0, longest))
            if process.poll() is None:
                strike(process, "kill all", rng)
                kills += 1
            code = ended(process, said)
            assert code in (0, -signal.SIGKILL), said.read_text()
        assert differences(expected, contents(output)) == []
        if kills >= KILLS:
            return


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
            assert "--resume" in said.read_text()
    with cluster(tmp_path, "last") as whole:
        process = start(whole)
        assert ended(process, said) == 0, said.read_text()
    assert differences(expected, contents(output)) == []
