"""Two FR3 that this project did not write carry the box of the torque bundle.

franky-sim simulates both arms in one MuJoCo scene (friction and rotors in the joints, a hand that
the planner does not know) and speaks the protocol of the robots; pylibfranka is libfranka itself.
The unedited `run_job.py` runs the whole job with its monitoring, in simulated time. Between it and
libfranka stands joint_trajectory_controller, reduced to its rules (`controlled.py`); its torque is
that of joint_trajectory_controller.cpp:417 (ros2_controllers jazzy).

`python -m tests.vendor.franka FILM.mp4` writes a film.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing as mp
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pylibfranka
import yaml
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hybrid_opt.extras.bundles import BundleOptions
from hybrid_opt.extras.bundles.bundle import prepared
from hybrid_opt.extras.bundles.job_file import Contents
from hybrid_opt.extras.bundles.targets import target_for
from studies.report.looks import Film, write_animation
from symbolic.array import Array
from symbolic.records import Handling, Workcell
from tests.hybrid_opt.cells import shipped
from tests.hybrid_opt.extras.bundles.bundles import DRIVER, driven
from tests.hybrid_opt.extras.bundles.mock_ros import World, run
from tests.hybrid_opt.job.jobs import jobs_of, timed
from tests.vendor.franka_scene import CYCLE, PATIENCE, Scene, simulate


class FrankaWorld(World):
    """A world in which libfranka drives both arms.

    Attributes:
        seen: per cycle time, force of both pads [N], place and quaternion of the box.
        references: per cycle both arms' desired positions.
    """

    step = CYCLE

    def __init__(
        self, files: Contents, config: dict[str, Any], hosts: Sequence[str], now: Any, share: float
    ) -> None:
        """Connect to both arms.

        Args:
            now: shared with `simulate`.
            share: of the feed-forward efforts that is commanded; the sensors feel it as the whole.
        """
        super().__init__(files, config)
        self.seen: list[Array] = []
        self.references: list[Array] = []
        self._now, self._share = now, share
        self._robots = [
            pylibfranka.Robot(host, pylibfranka.RealtimeConfig.kIgnore) for host in hosts
        ]
        self._controls: list[Any] = [None, None]
        self._gains = [_gains(files, arm, self.of(arm)[0].joints) for arm in (0, 1)]

    def serve(self, name: str, kind: str, request: Any) -> dict[str, Any]:
        """Answer a call by libfranka's own."""
        spaces = [group["action"].split("/")[1] for group in self.config["groups"]]
        arm = spaces.index(name.split("/")[1])
        robot = self._robots[arm]
        if kind.endswith("SetLoad"):
            robot.set_load(request.mass, request.center_of_mass, request.load_inertia)
        elif kind.endswith("SetFullCollisionBehavior"):
            thresholds = (
                request[f"{end}_{k}_thresholds_nominal"]
                for k in ("torque", "force")
                for end in ("lower", "upper")
            )
            robot.set_collision_behavior(*thresholds)
        elif request.activate_controllers:
            self._controls[arm] = robot.start_torque_control()
        return super().serve(name, kind, request)

    def move(self) -> None:
        """One cycle of libfranka, once both arms are controlled."""
        if not all(self._controls):
            return
        if self.log and self.log[-1].startswith("held"):
            # Nobody is there to say how to go on.
            self.interrupt()
        for arm, control in enumerate(self._controls):
            controller, _ = self.of(arm)
            state, _ = control.readOnce()
            q, dq = np.array(state.q), np.array(state.dq)
            p, d = self._gains[arm]
            torque = self._share * controller.effort
            torque += p * (controller.desired - q) + d * (controller.rate - dq)
            control.writeOnce(pylibfranka.Torques(torque.tolist()))
            controller.q = q
        self.references.append(np.concatenate([self.of(arm)[0].desired for arm in (0, 1)]))
        self.seen.append(np.array([self.now, *self._now]))

    def pressed(self, arm: int) -> float:
        """Normal force of a pad on the box [N], as its sensor feels it."""
        return float(self._now[arm]) / self._share


def _gains(files: Contents, arm: int, joints: Sequence[str]) -> tuple[Array, Array]:
    """The gains p and d of the bundle's controller [N m/rad, N m s/rad]."""
    known = yaml.safe_load(files[f"config/controllers_{arm + 1}.yaml"])["/**"]["carry_controller"]
    gains = [known["ros__parameters"]["gains"][name] for name in joints]
    return np.array([each["p"] for each in gains]), np.array([each["d"] for each in gains])


HANDLING = Handling(lift_height=0.02, set_down_height=0.02)
"""The carry begins and ends above the supports of the scene."""


def bundle() -> tuple[Workcell, Contents]:
    """The cell of two Pandas called as FR3, whose links are as long, and its torque bundle."""
    job = jobs_of("pandas").plan(timed("pandas"), handling=HANDLING)
    job = driven(job, replace(DRIVER, lag=0.0))
    names = tuple(tuple(n.replace("panda", "fr3") for n in own) for own in job.joint_names)
    job = replace(job, joint_names=(names[0], names[1]))
    target = target_for("torque", job.workcell)
    target.refuse(job, "torque", any_arm=False)
    return job.workcell, target.files(prepared(job, "torque", BundleOptions()))


@dataclass(frozen=True, eq=False)
class Outcome:
    """What happened in the scene, per cycle of the job.

    Attributes:
        code: exit code of `run_job.py`.
        log: what it said.
        time: (n,) since the job began [s].
        q: (n, 14) joint positions.
        force: (n, 2) normal force of each pad on the box [N].
        box: (n, 7) place [m] and quaternion (w first) of the box.
        document: the job's.
    """

    code: int
    log: list[str]
    time: Array
    q: Array
    force: Array
    box: Array
    document: dict[str, Any]

    @property
    def carried(self) -> NDArray[np.bool_]:
        """(n,) cycles of the carry."""
        (phase,) = (each for each in self.document["phases"] if each["name"] == "carry")
        begin, end = (self.document["time"][phase[key]] for key in ("first", "last"))
        return np.asarray((self.time > begin) & (self.time < end))

    @property
    def commanded(self) -> Array:
        """(n, 2) normal forces of the job [N]."""
        known, robots = self.document["time"], self.document["robots"]
        return np.transpose([np.interp(self.time, known, r["normal_force"]) for r in robots])

    @property
    def goal(self) -> Array:
        """(3,) where the box is to be set down [m]."""
        return np.array(self.document["box"]["pose"][-1][:3])


def carry(cell: Workcell, files: Contents, share: float = 1.0, high: float = 0.0) -> Outcome:
    """Run a bundle of two Frankas in a scene of two FR3.

    Args:
        cell: of the bundle.
        files: of the bundle.
        share: of the feed-forward efforts that is commanded; the sensors feel it as the whole.
        high: by which the support at the goal is higher than planned [m].
    """
    document = json.loads(files["job.json"])
    first = [tuple(robot["position"][0]) for robot in document["robots"]]
    poses = np.array(document["box"]["pose"])
    scene = Scene(cell, (first[0], first[1]), poses[0], poses[-1] + high * np.eye(6)[2])
    spawn = mp.get_context("spawn")
    here, there = spawn.Pipe()
    now = spawn.Array("d", 9, lock=False)
    simulation = spawn.Process(target=simulate, args=(scene, there, now), daemon=True)
    simulation.start()
    policy, priority = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        assert here.poll(PATIENCE), "franky-sim did not start"
        make = partial(FrankaWorld, hosts=here.recv(), now=now, share=share)
        with TemporaryDirectory() as folder:
            code, world = run(files, Path(folder), make=make)
    finally:
        # libfranka gives this thread, and what it starts later, the highest real-time priority.
        os.sched_setscheduler(0, policy, priority)
        here.send("over")
        simulation.join(PATIENCE)
    assert isinstance(world, FrankaWorld)
    seen = np.array(world.seen)
    q = np.array([row[1] for row in world.record[-len(seen) :]])
    moves = np.flatnonzero(np.abs(np.diff(world.references, axis=0)).max(axis=1))
    time = seen[:, 0] - seen[moves[0], 0]
    return Outcome(code, world.log, time, q, seen[:, 1:3], seen[:, 3:], document)


def main() -> None:
    """Carry the box and write a film."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("film", type=Path, help="to write: .mp4 or .gif")
    options = parser.parse_args()
    cell, files = bundle()
    found = carry(cell, files)
    turn = Rotation.from_quat(found.box[:, 3:], scalar_first=True)
    # Roll, pitch, yaw as in the cell's poses: Rz(yaw) Ry(pitch) Rx(roll).
    pose = np.hstack([found.box[:, :3], turn.as_euler("ZYX")[:, ::-1]])
    film = Film("two FR3 of franky-sim", found.time, pose, found.q)
    write_animation(shipped("pandas").geometry, film, options.film)
    print(found.log[-1])


if __name__ == "__main__":
    main()
