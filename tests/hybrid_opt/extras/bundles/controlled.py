"""Joint trajectory controllers and the arms that they drive, as a bundle's programs meet them.

The controllers are C++; these are their rules, after ros2_controllers jazzy
(joint_trajectory_controller.cpp: goals of an inactive controller are rejected, :1401; what is
validated, :1740; a hold has no effort, :2083; trajectory.cpp: quintic positions and linear efforts
between points, :296). libfranka sets a load only while no motion runs. Arms follow their commands
`lag` later; their sensors feel what the job's nearest sample presses.

NumPy only: environments of ROS 2 import it, too.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SUCCEEDED, CANCELED, ABORTED = 4, 5, 6
"""Of action_msgs/msg/GoalStatus."""

FLOAT_EPSILON = 1.1920929e-07

VALVE = 0.2
"""From a switched output of hands to what they do [s]."""

Ended = Callable[[int, str], None]
"""Gets the status of a goal that has ended, and why."""


class Controller:
    """A joint trajectory controller that commands efforts.

    Attributes:
        q: where its joints are.
        desired, rate, effort: of its reference.
        stands: joints that do not follow.
    """

    def __init__(self, time: Callable[[], float], joints: list[str], q: Array) -> None:
        self.time, self.joints = time, joints
        self.q, self.effort = q.copy(), np.zeros(len(q))
        self.desired, self.rate = q.copy(), np.zeros(len(q))
        self.is_active = self.refuses = False
        self.aborts_at: float | None = None
        self.stands = np.zeros(len(q), dtype=bool)
        self._times: Array | None = None
        self._pieces, self._rows = np.zeros((6, 1, len(q))), np.zeros((1, len(q)))
        self._start = 0.0
        self._ended: Ended | None = None

    def switch(self, is_active: bool) -> None:
        """`on_activate`: it holds where it is."""
        self.is_active = is_active
        self._hold()

    def accepts(self, trajectory: Any) -> bool:
        """`goal_received_callback` and `validate_trajectory_msg`."""
        points = trajectory.points
        rows = [
            row
            for point in points
            for row in (point.positions, point.velocities, point.accelerations, point.effort)
        ]
        return (
            self.is_active
            and not self.refuses
            and sorted(trajectory.joint_names) == sorted(self.joints)
            and bool((np.diff(times_of(points)) > 0.0).all())
            and max(abs(v) for v in points[-1].velocities) <= FLOAT_EPSILON
            and {len(row) for row in rows} == {len(self.joints)}
        )

    def take(self, trajectory: Any, ended: Ended) -> None:
        """Drive a trajectory that is accepted, in place of another one."""
        if self._ended is not None:
            self._end(CANCELED, "Current goal cancelled due to new incoming action.")
        points = trajectory.points
        order = [list(trajectory.joint_names).index(name) for name in self.joints]

        def column(name: str) -> Array:
            rows = np.array([getattr(point, name) for point in points], dtype=float)
            return np.asarray(rows[:, order])

        self._start, times = seconds(trajectory.header.stamp) or self.time(), times_of(points)
        known = [column(name) for name in ("positions", "velocities", "accelerations", "effort")]
        if self.time() - self._start < times[0]:
            # trajectory.cpp `sample`: from where it is to the first point.
            here = [self.desired, self.rate, np.zeros(len(self.q)), self.effort]
            known = [np.stack([first, *rows]) for first, rows in zip(here, known, strict=True)]
            times = np.array([self.time() - self._start, *times])
        self._times, self._rows = times, known[3]
        self._pieces = quintics(times, *known[:3])
        self._ended = ended

    def _hold(self) -> None:
        """`set_hold_position`: where it is, without effort."""
        self._times, self.effort = None, np.zeros(len(self.q))
        self.desired, self.rate = self.q.copy(), np.zeros(len(self.q))

    def _end(self, status: int, text: str) -> None:
        ended, self._ended = self._ended, None
        assert ended is not None
        ended(status, text)

    def step(self) -> None:
        """Sample the reference."""
        now = self.time()
        if self._times is None or now < self._start + self._times[0]:
            return
        if self.aborts_at is not None and now >= self.aborts_at:
            self.aborts_at = None
            self._end(ABORTED, "Aborted due to hardware")
            self._hold()
            return
        time = now - self._start
        place = float(np.clip(time, self._times[0], self._times[-1]))
        k = min(int(np.searchsorted(self._times, place, side="right")), len(self._times) - 1) - 1
        x, step = place - self._times[k], self._times[k + 1] - self._times[k]
        piece = self._pieces[:, k]
        self.desired, self.rate = x ** np.arange(6) @ piece, np.zeros(len(self.q))
        if self._times[0] < time < self._times[-1]:
            self.rate = np.arange(1, 6) * x ** np.arange(5) @ piece[1:]
        self.effort = self._rows[k] + x / step * (self._rows[k + 1] - self._rows[k])
        if time >= self._times[-1] and self._ended is not None:
            self._end(SUCCEEDED, "Goal successfully reached!")


def quintics(times: Array, position: Array, velocity: Array, acceleration: Array) -> Array:
    """Coefficients (6, n - 1, joints) of polynomials from each of n points to the next one."""
    h = np.diff(times)[:, None]
    p, (v, v1), (a, a1) = (
        np.diff(position, axis=0),
        (velocity[:-1], velocity[1:]),
        (acceleration[:-1], acceleration[1:]),
    )
    return np.stack(
        [
            position[:-1],
            v,
            a / 2.0,
            (20.0 * p - (8.0 * v1 + 12.0 * v) * h - (3.0 * a - a1) * h**2) / (2.0 * h**3),
            (-30.0 * p + (14.0 * v1 + 16.0 * v) * h + (3.0 * a - 2.0 * a1) * h**2) / (2.0 * h**4),
            (12.0 * p - 6.0 * (v1 + v) * h - (a - a1) * h**2) / (2.0 * h**5),
        ]
    )


def seconds(stamp: Any) -> float:
    return float(stamp.sec + 1e-9 * stamp.nanosec)


def times_of(points: Sequence[Any]) -> Array:
    return np.array([seconds(point.time_from_start) for point in points])


class ControlledCell:
    """Both arms and their controllers, without the way in which a program reaches them.

    Attributes:
        config: `config/cell.json` of the bundle.
        robots: both arms' parts of its job.
        calls: of services, by name and request.
        record: per step the time and both arms' positions and efforts.
        silent: arms that publish no joint states.
        offset: by which an arm's encoders are wrong [rad].
        felt: offset of each sensor [N]; None for one that is silent.
        sign: of what the sensors read when the pads press.
        lag: of each arm [s].
        fastest: largest speed of a joint [rad/s].
        switched: when the hands of an arm were switched, and whether on: (time, arm, on).
        leaks: arms whose hands do not hold.
    """

    def __init__(self, job: dict[str, Any], config: dict[str, Any]) -> None:
        self.config, self.robots = config, job["robots"]
        self.calls: list[tuple[str, Any]] = []
        self.record: list[tuple[Any, ...]] = []
        self.silent, self.offset = [False, False], [0.0, 0.0]
        self.felt: list[float | None] = [0.0, 0.0]
        self.sign, self.lag, self.fastest = 1.0, [0.0, 0.0], np.inf
        self.grips: list[dict[str, Any]] = config.get("grip", [])
        self.switched: list[tuple[float, int, bool]] = []
        self.leaks = [False, False]
        self.controllers: dict[str, Controller] = {}
        self._arms: dict[int, tuple[Controller, list[int]]] = {}
        for group in config["groups"]:
            robots = {arm: self.robots[arm] for arm in group["arms"]}
            first: dict[str, float] = {}
            for robot in robots.values():
                first |= dict(zip(robot["ros_joints"], robot["position"][0], strict=True))
            made = Controller(self.time, list(first), np.array(list(first.values())))
            self.controllers[group["action"]] = made
            for arm, robot in robots.items():
                self._arms[arm] = made, [made.joints.index(name) for name in robot["ros_joints"]]
        self._told: list[deque[tuple[float, Array]]] = [deque(), deque()]
        self._moved = [-np.inf, -np.inf]
        self._samples = [
            (np.array(robot["position"]), np.array(robot["hold_effort_without_gravity"]))
            for robot in self.robots
        ]

    def time(self) -> float:
        """Time of the controllers [s]."""
        raise NotImplementedError

    def of(self, arm: int) -> tuple[Controller, list[int]]:
        """An arm's controller, and the places of the arm's joints among its own."""
        return self._arms[arm]

    def q(self, arm: int) -> Array:
        controller, part = self.of(arm)
        return controller.q[part]

    def effort(self, arm: int) -> Array:
        controller, part = self.of(arm)
        return controller.effort[part]

    def drive(self) -> None:
        """One cycle of the controllers and arms."""
        for controller in self.controllers.values():
            controller.step()
        self.move()
        both = [np.concatenate([each(0), each(1)]) for each in (self.q, self.effort)]
        self.record.append((self.time(), *both))

    def move(self) -> None:
        """Let all arms follow: they are where their controllers want them."""
        for arm, lag in enumerate(self.lag):
            controller, part = self.of(arm)
            told = self._told[arm]
            told.append((self.time(), controller.desired[part]))
            while len(told) > 1 and told[1][0] <= self.time() - lag + 1e-9:
                told.popleft()
            if controller.is_active:
                most = self.fastest * (told[-1][0] - self._moved[arm])
                step = np.clip(told[0][1] - controller.q[part], -most, most)
                controller.q[part] += np.where(controller.stands[part], 0.0, step)
            self._moved[arm] = told[-1][0]

    def pressed(self, arm: int) -> float:
        """Normal force [N] of the job's sample whose posture and effort are the nearest."""
        q, effort = self._samples[arm]
        far = np.abs(q - self.q(arm)).max(axis=1) * 1e3
        far += np.abs(effort - self.effort(arm)).max(axis=1)
        return float(self.robots[arm]["normal_force"][int(np.argmin(far))])

    def is_on(self, arm: int, before: float = 0.0) -> bool:
        """Whether the output of an arm's hands was on some time before now [s]."""
        past = [on for then, a, on in self.switched if a == arm and then <= self.time() - before]
        return past[-1] if past else False

    def holds(self, arm: int) -> bool:
        """What the input of an arm's hands says."""
        return self.is_on(arm, VALVE) and not self.leaks[arm]

    def _switch(self, name: str, kind: str, request: Any) -> None:
        for arm, grip in enumerate(self.grips):
            if name == grip["name"]:
                is_line = kind.endswith("SetIO")
                assert not is_line or (request.fun, request.pin) == (1, grip["on"]["pin"])
                on = request.state > 0.0 if is_line else request.data
                self.switched.append((self.time(), arm, bool(on)))

    def serve(self, name: str, kind: str, request: Any) -> dict[str, Any]:
        """Answer a call of a service by the fields of its response."""
        self.calls.append((name, request))
        self._switch(name, kind, request)
        space = name.split("/")[1]
        own = [c for action, c in self.controllers.items() if action.startswith(f"/{space}/")]
        own = own or list(self.controllers.values())
        if kind.endswith("SwitchController"):
            for controller in own:
                controller.switch(bool(request.activate_controllers))
            return {"ok": True}
        if kind.endswith("SetLoad") and any(controller.is_active for controller in own):
            return {"success": False, "error": "command rejected: motion running"}
        return {"success": True}
