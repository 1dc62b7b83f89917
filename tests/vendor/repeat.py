"""Repeat jobs and faults through makers' code, and print a table of what happened.

    python -m tests.vendor.repeat franka --runs 20 --beside 3

WORLD is a driver of the target torque over ROS 2 (`simulation`, `franka`, `ur`), or `egm`. Without
`--whole` the job is short (`short.py`). Moments and arms of faults are drawn by `--seed`. A run is
sound if the pads never part by more than the bundle states, the exit code and the message are those
of the fault, and `back` has brought the box home where it has to. `--load` lets so many processes
compute beside.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing as mp
import os
import random
import re
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from hybrid_opt.extras.bundles.programs.carry_job import Job
from symbolic.array import Array
from tests.vendor import egm, ros
from tests.vendor.short import Bundle, torque
from tests.vendor.short import egm as egm_bundle

SKEW = 0.010
"""Allowed between the starts of both arms [s]."""

HOME = 1e-3
"""Allowed distance of joints from where they began, or from the end of the job [rad]."""

SHARE = 1.5
"""Allowed force over the largest commanded one."""


@dataclass(frozen=True)
class Fault:
    """What goes wrong, and what has to follow.

    Attributes:
        name: of the fault.
        told: expression that the program's words match.
        code: exit code.
        ends: where the arms are in the end: 'start', 'end', or '' for where they stopped.
    """

    name: str
    told: str
    code: int
    ends: str


FAULTS = (
    Fault("none", "done", 0, "end"),
    Fault("goal rejected", "does not take its goal|does not follow", 2, "start"),
    Fault("one arm stops", "left its path|behind|apart", 3, "start"),
    Fault("controller gives up", "ended|does not follow", 3, "start"),
    Fault("paused 50 ms", "done", 0, "end"),
    Fault("paused 200 ms", "done", 0, "end"),
    Fault("link lost", "no news from|no force is measured", 3, "start"),
    Fault("kill -9", "", -signal.SIGKILL, ""),
    Fault("Ctrl-C", "Ctrl-C", 3, "start"),
    Fault("start off by 3 degrees", "mm from its place", 2, ""),
    Fault("sensor off by 10 N", "zero its sensor", 2, "start"),
    Fault("sensor silent", "no force is measured", 3, "start"),
    Fault("news late", "done", 0, "end"),
)

WITHOUT_SENSORS = ("sensor off by 10 N", "sensor silent")
"""Faults of sensors, which a simulator has none of."""


@dataclass(frozen=True)
class Trial:
    """A run and what is wrong with it.

    Attributes:
        parted: largest distance by which the pads were off their relative place [m].
        skew: between the starts of both arms [s].
        force: largest force over the largest commanded one; 0 where it is not simulated.
        wrong: what is not as it should be.
        said: last line of the program.
    """

    parted: float
    skew: float
    force: float
    wrong: tuple[str, ...]
    said: str


@dataclass(frozen=True, eq=False)
class Ended:
    """What a world has seen of a run."""

    code: int
    log: str
    q: Array
    skew: float
    force: float


def pausing(live: Any, seconds: float, wait: Any) -> None:
    """Stop a program for some time."""
    live.program.send_signal(signal.SIGSTOP)
    wait(seconds)
    live.program.send_signal(signal.SIGCONT)


# --- ROS 2 ---

OF_CELL = {
    "goal rejected": "rejects",
    "one arm stops": "stands",
    "controller gives up": "aborts",
    "link lost": "lost",
    "start off by 3 degrees": "elsewhere",
    "sensor off by 10 N": "offset",
    "sensor silent": "deaf",
    "news late": "late",
}
"""Faults of `ros_cell.py`."""

FROM_THE_BEGINNING = (
    "goal rejected",
    "start off by 3 degrees",
    "sensor off by 10 N",
    "news late",
)


def run_ros(bundle: Bundle, fault: Fault, moment: float, arm: int, folder: Path) -> Ended:
    """Run a bundle of the target torque."""
    name = fault.name
    own = []
    if name in OF_CELL:
        own = [OF_CELL[name], -1.0 if name in FROM_THE_BEGINNING else moment, arm]
    end = float(bundle.export.sampled.time[-1])

    def act(live: ros.Live) -> None:
        if fault.code == 2 or name in ("none", "news late"):
            return
        if name not in OF_CELL:
            live.wait_until(moment)
        if name.startswith("paused"):
            seconds = float(name.split()[1]) / 1e3
            pausing(live, seconds / ros.SPEED, time.sleep)
        elif name == "kill -9":
            live.program.kill()
            live.wait_until(end + 0.5)
        elif name == "Ctrl-C":
            live.program.send_signal(signal.SIGINT)
        if fault.code == 3:
            live.wait_for("held in", after=0.5)
            live.heal()
            time.sleep(0.5 / ros.SPEED)
            live.back()

    found = ros.run(bundle.files, folder, *own, act=act)
    skew = float(np.ptp(found.starts)) if len(found.starts) else 0.0
    return Ended(found.code, found.log, found.q, skew, 0.0)


# --- EGM ---

REALTIME = ("chrt", "-r", "5")
"""Starts a program with real-time priority."""


def run_egm(
    bundle: Bundle, fault: Fault, moment: float, arm: int, folder: Path, is_realtime: bool
) -> Ended:
    """Run a bundle of the target abb-egm."""
    before = REALTIME if is_realtime else ()
    cell, name = egm.Controllers(bundle.files, folder, before=before), fault.name
    try:
        if name == "goal rejected":
            cell.stopped = True
        elif name == "start off by 3 degrees":
            cell.turn(arm, np.deg2rad(3.0))
        elif name == "sensor off by 10 N":
            cell.offset = 10.0
        elif name == "news late":
            cell.late = 0.06
        else:
            cell.run(cell.at(moment))
        if name == "one arm stops":
            cell.stands[arm] = True
        elif name == "controller gives up":
            cell.stopped = True
        elif name == "link lost":
            cell.silent[arm] = True
        elif name == "sensor silent":
            cell.deaf = True
        elif name == "Ctrl-C":
            cell.program.send_signal(signal.SIGINT)
        elif name.startswith("paused"):
            pausing(cell, float(name.split()[1]) / 1e3, cell.go_on)
        elif name == "kill -9":
            cell.program.kill()
            cell.program.wait()
            cell.go_on(1.0)
        if fault.code == 3:
            cell.run(lambda: "held in" in cell.said())
            cell.go_on(0.5)
            cell.heal()
            cell.go_on(0.5)
            cell.command("back")
        cell.run(lambda: "held in" in cell.said() and fault.code == 0)
        if cell.program.poll() is None:
            cell.command("leave")
            cell.run(lambda: False)
        force = max(row[1] for row in cell.record)
        largest = max(cell.job.robots[cell.pressing]["normal_force"])
        q = np.array([row[2] for row in cell.record])
        return Ended(int(cell.program.wait()), cell.said(), q, 0.0, force / largest)
    finally:
        cell.program.kill()
        cell.program.wait()


# --- both ---


def subject(world: str, is_whole: bool) -> Bundle:
    """The bundle that a world runs."""
    if world == "egm":
        return egm_bundle(egm.LOCAL, not is_whole)
    return torque(world, not is_whole)


def tried(world: str, fault: Fault, is_whole: bool, is_realtime: bool, seed: int) -> Trial:
    """Run once, with a moment and an arm by a seed."""
    bundle = subject(world, is_whole)
    job = Job(json.loads(bundle.files["job.json"]))
    rng = random.Random(seed)
    moment, arm = rng.uniform(job.begin("lift"), job.begin("release")), rng.randrange(2)
    run = partial(run_egm, is_realtime=is_realtime) if world == "egm" else run_ros
    try:
        with TemporaryDirectory() as folder:
            found = run(bundle, fault, moment, arm, Path(folder))
    except (AssertionError, OSError, subprocess.SubprocessError) as error:
        return Trial(0.0, 0.0, 0.0, (f"at {moment:.3f} s, arm {arm}: {error}",), "")
    parted, wrong = bundle.parted(found.q), []
    if found.code != fault.code:
        wrong.append(f"exit code {found.code}")
    if not re.search(fault.told, found.log):
        wrong.append("other words")
    if parted > bundle.stated:
        wrong.append(f"pads part by {1e3 * parted:.1f} mm")
    if found.skew > SKEW:
        wrong.append(f"skew {1e3 * found.skew:.1f} ms")
    if found.force > SHARE:
        wrong.append(f"{found.force:.2f} times the force")
    ends = {"start": 0.0, "end": job.end}
    if fault.ends in ends:
        places = np.concatenate([job.position(a, ends[fault.ends]) for a in (0, 1)])
        if np.abs(found.q[-1] - places).max() > HOME:
            wrong.append(f"not at its {fault.ends}")
    if fault.code == 2 and np.ptp(found.q, axis=0).max() > HOME:
        wrong.append("moved")
    if wrong:
        wrong.append(f"at {moment:.3f} s, arm {arm}: {found.log}")
    return Trial(parted, found.skew, found.force, tuple(wrong), found.log.strip()[-300:])


@contextmanager
def computing(count: int) -> Any:
    """Let processes compute in the meantime."""
    busy = [mp.Process(target=_compute, daemon=True) for _ in range(count)]
    for each in busy:
        each.start()
    try:
        yield
    finally:
        for each in busy:
            each.terminate()


def _compute() -> None:
    while True:
        sum(range(100_000))


def main(arguments: Sequence[str] | None = None) -> int:
    """Repeat faults; returns 1 if a run was not sound."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("world", choices=("simulation", "franka", "ur", "egm"))
    parser.add_argument("--runs", type=int, default=20, help="of every fault (20)")
    parser.add_argument("--beside", type=int, default=1, help="runs at the same time (1)")
    parser.add_argument("--only", nargs="+", help="names of faults, or the beginnings of names")
    parser.add_argument(
        "--whole", action="store_true", help="the rack's whole job, not a short one"
    )
    parser.add_argument("--realtime", action="store_true", help="start run_egm.py by chrt")
    parser.add_argument("--load", type=int, default=0, help="processes that compute beside (0)")
    parser.add_argument("--seed", type=int, default=1, help="of moments and arms (1)")
    options = parser.parse_args(arguments)
    chosen = [
        fault
        for fault in FAULTS
        if (not options.only or fault.name.startswith(tuple(options.only)))
        and not (options.world == "simulation" and fault.name in WITHOUT_SENSORS)
    ]
    bundle = subject(options.world, options.whole)
    load = " ".join(f"{each:.1f}" for each in os.getloadavg())
    print(f"{options.world}, load average {load}: {bundle.export.partner_stop}", flush=True)
    print(
        "| fault | sound | pads part [mm] | skew [ms] | force | says |\n|---|---|---|---|---|---|"
    )
    is_sound = True
    with computing(options.load), ProcessPoolExecutor(options.beside) as pool:
        for fault in chosen:
            seeds = [1000 * options.seed + k for k in range(options.runs)]
            once = partial(tried, options.world, fault, options.whole, options.realtime)
            begun = [pool.submit(once, seed) for seed in seeds]
            found = [each.result() for each in begun]
            sound = [not trial.wrong for trial in found]
            parted, skew, force = (
                max(getattr(trial, name) for trial in found) for name in ("parted", "skew", "force")
            )
            said = found[0].said.splitlines()[-1:] or [""]
            print(
                f"| {fault.name} | {sum(sound)} of {len(found)} | {1e3 * parted:.1f} "
                f"| {1e3 * skew:.1f} | {force:.2f} | {said[0]} |",
                flush=True,
            )
            for trial in found:
                if trial.wrong:
                    print(*trial.wrong, sep="\n  ", file=sys.stderr, flush=True)
            is_sound = is_sound and all(sound)
    return 0 if is_sound else 1


if __name__ == "__main__":
    sys.exit(main())
