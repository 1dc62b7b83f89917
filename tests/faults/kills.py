"""Kill a study at random moments of every stage, resume it, and compare with one left in peace.

`python -m tests.faults.kills --kills 50 --seed 1` does it until it has hit living programs fifty
times, and tells what it found. Each folder is struck in every stage and before the first, in one of
the ways a process dies: killed outright, alone or with all it has started, interrupted from the
keyboard, asked to end, or robbed of a worker.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.symbolic.cells import ROOT

CELL = ROOT / "studies" / "workcells" / "transfer.toml"
SMALL = (
    *("--evaluations", "60", "--replicas", "2", "--polish-attempts", "1", "--seed", "3"),
    *("--population", "nsga2=20", "--population", "mopso=20", "--jobs", "2"),
)
STAGES = ("search", "polish", "drivable", "recommendation", "summary", "timing", "report")
BEGINNING = "beginning"
"""Before the first stage: the cell is read and its functions are compiled or loaded."""

STRIKES = (BEGINNING, *sorted(2 * STAGES, key=STAGES.index))
"""Where one folder is struck, in the order in which a study gets there."""

WAYS = ("kill", "kill all", "interrupt", "terminate", "kill a worker")
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


class Broken(AssertionError):
    """A promise was not kept."""


@dataclass
class Tally:
    """What was done and found; a hit met a living program, or a living worker of one.

    Attributes:
        hits: how often programs were struck.
        misses: how often a program had ended before.
        ways, stages: hits by the way and by the stage that was running.
        ends: how programs that were struck ended.
    """

    hits: int = 0
    misses: int = 0
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


def strike(process: subprocess.Popen[bytes], way: str, rng: random.Random) -> bool:
    """Let a program die in this way, or lose a worker; whether there was anything to strike."""
    others = session(process.pid)
    struck = [process.pid, *others]
    number = signal.SIGKILL
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
        _signal(one, number)
    return bool(struck)


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


def running(output: Path) -> str:
    """The stage that a study is at."""
    return next((stage for stage in STAGES if _status(output, stage) == "running"), "between")


def _status(output: Path, stage: str) -> str:
    try:
        found = json.loads((output / "stages" / f"{stage}.json").read_text())
        return str(found["status"])
    except (OSError, ValueError, KeyError):
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
    folder: Path, strikes: Sequence[str], took: dict[str, float], seed: int, tally: Tally
) -> dict[str, Any]:
    """The contents of a study that was struck in these stages, in order, and resumed each time."""
    rng = random.Random(seed)
    report = "report" in took
    output, said = folder / "results", folder / "said"

    def start() -> subprocess.Popen[bytes]:
        return started(study(output, output.exists(), report), said)

    process = start()
    for stage in strikes:
        if process.poll() is not None:
            ended(process, said)
            process = start()
        if stage != BEGINNING:
            wait_for(stage, output, process)
        # A stage that was resumed has less to do than it had at first.
        linger(rng.uniform(0.0, 0.7 * took[stage]), stage, output, process)
        way, at = rng.choice(WAYS), running(output)
        if process.poll() is not None:
            tally.misses += 1
            continue
        if not strike(process, way, rng):
            way = "kill"
            strike(process, way, rng)
        tally.hits += 1
        tally.ways[way] += 1
        tally.stages[BEGINNING if stage == BEGINNING else at] += 1
        if way != "kill a worker":  # a study goes on without one
            tally.ends[str(ended(process, said))] += 1
    ended(process, said)
    code = ended(start(), said)
    if code != 0:
        raise Broken(f"cannot be resumed, exit code {code}:\n{said.read_text(errors='replace')}")
    return contents(output)


def undisturbed(folder: Path, report: bool) -> tuple[dict[str, Any], dict[str, float]]:
    """The contents of a study left in peace, and what its stages took [s]."""
    output, said = folder / "results", folder / "said"
    code = ended(started(study(output, False, report), said), said)
    if code != 0:
        raise Broken(f"exit code {code}:\n{said.read_text(errors='replace')}")
    took = durations(output)
    return contents(output), took | {BEGINNING: took["search"]}


def main() -> int:
    """Kill, resume, compare until living programs were hit so often; the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults.kills", description=__doc__)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    tally, wrong = Tally(), 0
    with tempfile.TemporaryDirectory() as place:
        (Path(place) / "peace").mkdir()
        expected, took = undisturbed(Path(place) / "peace", report=True)
        print("undisturbed:", {name: round(s, 1) for name, s in took.items()}, flush=True)
        for number in itertools.count():
            left = options.kills - tally.hits
            if left <= 0:
                break
            folder = Path(place) / f"struck{number}"
            folder.mkdir()
            try:
                found = struck(folder, STRIKES[:left], took, options.seed * 1000 + number, tally)
                different = differences(expected, found)
            except (Broken, subprocess.TimeoutExpired) as error:
                different = [str(error)]
            wrong += bool(different)
            told = f"folder {number}: {tally.hits} hits, {tally.misses} too late:"
            print(told, different or "same", flush=True)
            shutil.rmtree(folder)
    print("ways:", dict(tally.ways))
    print("stages:", dict(tally.stages))
    print("exit codes:", dict(tally.ends))
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
