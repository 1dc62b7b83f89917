"""Kill a study at random moments of every stage, resume it, and compare with one left in peace.

`python -m tests.faults.kills --kills 50 --seed 1` does it fifty times and tells what it found. Each
folder is struck once in every stage, in one of the ways a process dies: killed outright, alone or
with all it has started, interrupted from the keyboard, asked to end, or robbed of a worker.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.symbolic.cells import ROOT

CELL = ROOT / "studies" / "workcells" / "transfer.toml"
SMALL = (
    *("--evaluations", "60", "--replicas", "2", "--polish-points", "1", "--seed", "3"),
    *("--population", "nsga2=20", "--population", "mopso=20", "--jobs", "2"),
)
STAGES = ("search", "polish", "summary", "timing", "report")
WAYS = ("kill", "kill all", "interrupt", "terminate", "kill a worker")
TIMES = {"seconds", "median_attempt_seconds", "equivalent_evaluations"}
"""Figures that are times, or follow from them."""

ENDS = {0, 2, 130, -signal.SIGINT, -signal.SIGKILL, -signal.SIGTERM}
PATIENCE = 300.0
ORPHANS_END = 60.0
"""So many seconds [s] after its parent's death a worker may still be there."""


class Broken(AssertionError):
    """A promise was not kept."""


@dataclass
class Tally:
    """What was done and found."""

    ways: Counter[str] = field(default_factory=Counter)
    stages: Counter[str] = field(default_factory=Counter)
    ends: Counter[str] = field(default_factory=Counter)


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
    """Let a program die in this way, or lose a worker."""
    others = session(process.pid)
    match way:
        case "kill":
            process.kill()
        case "kill all":
            for one in [process.pid, *others]:
                _signal(one, signal.SIGKILL)
        case "interrupt":  # as a terminal does it: all of the foreground hear it
            for one in [process.pid, *others]:
                _signal(one, signal.SIGINT)
        case "terminate":
            process.terminate()
        case "kill a worker" if others:
            _signal(rng.choice(others), signal.SIGKILL)


def _signal(one: int, number: int) -> None:
    try:
        os.kill(one, number)
    except ProcessLookupError:
        return


def ended(process: subprocess.Popen[bytes], said: Path) -> int:
    """Wait for a program's end and hold it to its promises; the exit code."""
    code = process.wait(timeout=PATIENCE)
    words = said.read_text(errors="replace")
    if code not in ENDS or "Traceback" in words:
        raise Broken(f"exit code {code}, said:\n{words[-4000:]}")
    if code in (2, 130, -signal.SIGINT) and not words.strip():
        raise Broken(f"exit code {code} without a message")
    begin = time.monotonic()
    while left := session(process.pid):
        if time.monotonic() - begin > ORPHANS_END:
            raise Broken(f"{len(left)} workers outlive their program")
        time.sleep(0.1)
    return code


def wait_for(stage: str, output: Path, process: subprocess.Popen[bytes]) -> None:
    """Wait until a stage is running, or the program has ended."""
    path = output / "stages" / f"{stage}.json"
    while process.poll() is None:
        try:
            if json.loads(path.read_text())["status"] in ("running", "done"):
                return
        except (OSError, ValueError, KeyError):
            pass
        time.sleep(0.01)


def durations(output: Path) -> dict[str, float]:
    """What each stage took [s]."""
    found = {}
    for stage in STAGES:
        path = output / "stages" / f"{stage}.json"
        if path.exists():
            found[stage] = float(json.loads(path.read_text())["seconds"])
    return found


def contents(root: Path) -> dict[str, Any]:
    """Every file of a results folder; of JSON the values, without times."""
    found: dict[str, Any] = {}
    for path in sorted(root.rglob("*")):
        name = path.relative_to(root).as_posix()
        if path.is_file() and not any(part.startswith(".") for part in name.split("/")):
            content = path.read_bytes()
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


def struck(
    folder: Path, kills: int, took: dict[str, float], seed: int, tally: Tally
) -> dict[str, Any]:
    """The contents of a study that was struck so often, and resumed after each time."""
    rng = random.Random(seed)
    report = "report" in took
    output, said = folder / "results", folder / "said"
    stages = [stage for stage in STAGES if stage in took]
    for k in range(kills):
        stage, way = stages[k % len(stages)], rng.choice(WAYS)
        process = started(study(output, output.exists(), report), said)
        wait_for(stage, output, process)
        moment = rng.uniform(0.0, took[stage])
        time.sleep(moment)
        alive = process.poll() is None
        strike(process, way, rng)
        code = ended(process, said)
        tally.ways[way] += 1
        tally.stages[stage if alive else "too late"] += 1
        tally.ends[str(code)] += 1
    code = ended(started(study(output, output.exists(), report), said), said)
    if code != 0:
        raise Broken(f"cannot be resumed, exit code {code}:\n{said.read_text(errors='replace')}")
    return contents(output)


def undisturbed(folder: Path, report: bool) -> tuple[dict[str, Any], dict[str, float]]:
    """The contents of a study left in peace, and what its stages took [s]."""
    output, said = folder / "results", folder / "said"
    code = ended(started(study(output, False, report), said), said)
    if code != 0:
        raise Broken(f"exit code {code}:\n{said.read_text(errors='replace')}")
    return contents(output), durations(output)


def rounds(kills: int, each: int) -> Iterator[int]:
    """How often each folder is struck, so that all are."""
    while kills > 0:
        yield min(kills, each)
        kills -= each


def main() -> int:
    """Kill, resume, compare; the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults.kills", description=__doc__)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    tally, wrong = Tally(), 0
    with tempfile.TemporaryDirectory() as place:
        (Path(place) / "peace").mkdir()
        expected, took = undisturbed(Path(place) / "peace", report=True)
        print(
            "undisturbed:",
            {stage: round(seconds, 1) for stage, seconds in took.items()},
            flush=True,
        )
        for number, kills in enumerate(rounds(options.kills, len(STAGES))):
            folder = Path(place) / f"struck{number}"
            folder.mkdir()
            try:
                found = struck(folder, kills, took, options.seed * 1000 + number, tally)
                different = differences(expected, found)
            except (Broken, subprocess.TimeoutExpired) as error:
                different = [str(error)]
            wrong += bool(different)
            print(f"folder {number}, {kills} kills:", different or "same", flush=True)
    print("ways:", dict(tally.ways))
    print("stages:", dict(tally.stages))
    print("exit codes:", dict(tally.ends))
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
