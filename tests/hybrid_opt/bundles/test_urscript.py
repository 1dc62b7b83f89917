"""Both URScript programs, read as the Python that they nearly are, run side by side against mock
arms of Universal Robots' script manual: servoj, force mode, digital lines, threads."""

from __future__ import annotations

import ast
import re
import threading
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

import numpy as np
import pytest

from hybrid_opt.bundles import TARGETS, BundleOptions
from hybrid_opt.bundles.bundle import prepared
from hybrid_opt.bundles.languages import urscript_files
from hybrid_opt.job.records import HELD, PHASES
from symbolic.errors import SettingsError
from tests.hybrid_opt.bundles.bundles import contents, exported, rack_driven
from tests.hybrid_opt.job.jobs import rack_job

BLOCK = re.compile(r"^(\s*)(def|thread|if|while|elif|else)\b.*:$")
CYCLE = 0.002


def as_python(script: str) -> ast.Module:
    """The program as Python's parser reads it: blocks end by `end`, poses are lists, threads are
    generators that yield at `sync()`.

    Every `end` has to stand where the block begins that it closes.
    """
    lines: list[str] = []
    opened: list[tuple[int, bool]] = []
    for line in script.splitlines():
        code = line.split("#")[0].rstrip()
        found = BLOCK.match(code)
        if found and found[2] in ("elif", "else"):
            assert len(found[1]) == opened[-1][0]
        elif found:
            opened.append((len(found[1]), found[2] == "thread"))
        if code.strip() == "end":
            assert len(code) - len("end") == opened.pop()[0]
            continue
        code = re.sub(r"\bp\[", "[", code)
        code = re.sub(r"^(\s*)thread ", r"\1def ", code)
        code = re.sub(r"\brun (\w+)\(\)", r"run(\1)", code)
        code = re.sub(r"^(\s*)kill (\w+)", r"\1kill(\2)", code)
        code = re.sub(r"^(\s*)global (\w+) = ", r'\1globals()["\2"] = ', code)
        if any(is_thread for _, is_thread in opened):
            code = code.replace("sync()", "yield")
        lines.append(code)
    assert not opened
    return ast.parse("\n".join(lines))


class Halted(Exception):
    """`halt`."""


class Arm:
    """What a program calls; its joints follow servoj at once."""

    def __init__(self, pair: Pair, start: Any) -> None:
        self.pair, self.q = pair, np.array(start)
        self.outs, self.buttons = [False] * 8, [False] * 8
        # What the other arm sees: of the last cycle, whichever of both threads runs first.
        self.shown, self.felt = [False] * 8, 0.0
        self.newton, self.offset, self.pressed = 0.0, 0.0, False
        self.log: list[str] = []
        self.record: list[tuple[float, np.ndarray[Any, Any], float]] = []
        self.payload: list[float] = []
        self.threads: dict[int, Iterator[None]] = {}
        self.stopped = self.ended = False
        self._rest = 0.0

    @property
    def other(self) -> Arm:
        first, second = self.pair.arms
        return second if self is first else first

    def cycles(self, seconds: float) -> int:
        self._rest += seconds / CYCLE
        whole = int(self._rest + 1e-9)
        self._rest -= whole
        return whole

    def names(self) -> dict[str, Any]:
        def servoj(q: list[float], t: float, lookahead_time: float, gain: float) -> None:
            assert 0.03 <= lookahead_time <= 0.2
            assert 100 <= gain <= 2000
            assert t >= CYCLE - 1e-9
            begin, count = self.q.copy(), self.cycles(t)
            for k in range(count):
                self.q = begin + (np.array(q) - begin) * (k + 1) / count
                self.pair.cycle(self)

        def force_mode(frame: Any, selection: Any, wrench: Any, kind: int, limits: Any) -> None:
            assert selection == [0, 0, 1, 0, 0, 0]
            assert kind == 2
            assert len(limits) == 6
            self.newton, self.pressed = wrench[2], True

        def end_force_mode() -> None:
            self.newton = 0.0
            self.log.append("end force")

        def line(number: int) -> bool:
            return self.other.shown[number] if number < 2 else self.buttons[number]

        def run(body: Callable[[], Iterator[None]]) -> int:
            self.threads[len(self.threads)] = body()
            return len(self.threads) - 1

        return {
            "servoj": servoj,
            "force_mode": force_mode,
            "end_force_mode": end_force_mode,
            "force_mode_set_damping": lambda value: self.log.append(f"damping {value}"),
            "force_mode_set_gain_scaling": lambda value: self.log.append(f"gain {value}"),
            "zero_ftsensor": lambda: self.log.append("zero"),
            "set_tcp": lambda pose: self.log.append(f"tcp {len(pose)}"),
            "set_target_payload": lambda mass, centre: self.payload.append(mass),
            "get_actual_joint_positions": lambda: self.q.tolist(),
            "get_actual_tcp_pose": lambda: [0.0] * 6,
            "set_standard_digital_out": self.outs.__setitem__,
            "get_standard_digital_in": line,
            "force": lambda: max(self.felt, self.other.felt) + self.offset,
            "norm": abs,
            "popup": lambda text, blocking: self.log.append(f"popup {text}"),
            "textmsg": self.log.append,
            "stopj": lambda rate: self.log.append("stop"),
            "run": run,
            "kill": lambda number: self.threads.pop(number),
        }


class Pair:
    """Two arms in lockstep.

    Attributes:
        time: [s].
        at: what happens at which time.
    """

    def __init__(self, starts: list[Any], at: dict[float, Callable[[Pair], None]]) -> None:
        self.arms = (Arm(self, starts[0]), Arm(self, starts[1]))
        self.time, self.at = 0.0, dict(at)
        self.most = 60.0
        self._barrier = threading.Barrier(2, action=self._tick)

    def _tick(self) -> None:
        self.time += CYCLE
        for arm in self.arms:
            arm.shown, arm.felt = list(arm.outs), arm.newton
        for when in [when for when in self.at if when <= self.time]:
            self.at.pop(when)(self)
        for arm in self.arms:
            if not (arm.stopped or arm.ended):
                for thread in list(arm.threads.values()):
                    next(thread, None)
            arm.record.append((self.time, arm.q.copy(), arm.newton))

    def cycle(self, arm: Arm) -> None:
        """One cycle of an arm's program; a stopped one stays in it."""
        while True:
            if self.time > self.most:
                raise Halted("the time is over")
            self._barrier.wait()
            if not arm.stopped:
                return

    def run(self) -> Pair:
        errors: list[BaseException] = []

        def drive(arm: Arm, module: ast.Module) -> None:
            space = arm.names()
            try:
                exec(compile(module, "script", "exec"), space)
                space["carry_job"]()
                arm.log.append("ended")
            except (NameError, Halted) as error:
                arm.log.append("halt" if "halt" in str(error) else str(error))
            except threading.BrokenBarrierError:
                return
            except BaseException as error:
                errors.append(error)
                self._barrier.abort()
                return
            arm.ended = True
            try:
                while not all(each.ended for each in self.arms):
                    self._barrier.wait()
            except threading.BrokenBarrierError:
                return
            self._barrier.abort()

        threads = [
            threading.Thread(target=drive, args=pair)
            for pair in zip(self.arms, programs(), strict=True)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        if errors:
            raise errors[0]
        return self


@cache
def programs() -> list[ast.Module]:
    return [as_python(str(text)) for text in contents("ur-script").values()]


def pair(at: dict[float, Callable[[Pair], None]] | None = None, away: float = 0.0) -> Pair:
    job = exported("ur-script").sampled
    starts = [job.arm(arm, job.q)[0] for arm in (0, 1)]
    return Pair([starts[0] + away, starts[1]], at or {})


def test_both_programs_stream_the_job_and_press() -> None:
    job, found = exported("ur-script").sampled, pair().run()
    follower = exported("ur-script").follower
    np.testing.assert_allclose(np.diff(job.time), 0.008, atol=1e-9)
    moved = [np.array([row[1] for row in arm.record]) for arm in found.arms]
    begin = begun(moved[0])
    for arm, q in enumerate(moved):
        assert found.arms[arm].log[-2:] == ["stop", "ended"], found.arms[arm].log
        planned = job.arm(arm, job.q)
        # One point in four cycles of 2 ms.
        for k in range(1, len(planned), 50):
            # Where the first begins is known to a cycle.
            near = 1.1 * CYCLE * np.abs(job.arm(arm, job.q_rate)[k]) + 1e-5
            assert (np.abs(q[begin + 4 * k] - planned[k]) <= near).all(), k
    newton = np.array([row[2] for row in found.arms[follower].record])
    assert newton.max() == pytest.approx(job.normal_force[:, follower].max(), abs=1.0)
    # Nowhere less than the box needs while it is held, and no more than within 0.1 s of it.
    wanted = job.normal_force[:, follower]
    for k in range(len(job.time)):
        near = wanted[max(0, k - 12) : k + 13]
        assert newton[begin + 4 * k] <= near.max() + 0.5
        assert newton[begin + 4 * k] >= near.min() - 0.5
        if in_held(float(job.time[k])):
            assert newton[begin + 4 * k] >= wanted[k] - 0.5
    assert not found.arms[1 - follower].pressed
    log = found.arms[follower].log
    assert log.index("zero") < log.index("damping 0.1") < log.index("end force")
    for each in found.arms:
        assert np.abs(np.diff(each.payload)).max() < 0.5, "the payload is a ramp"
        assert max(each.payload) == pytest.approx(rack_job().workcell.payload.mass / 2.0, abs=0.01)


def in_held(s: float) -> bool:
    held = rack_job().held
    return held[0].begin + 0.1 < s < held[-1].begin + held[-1].duration - 0.01


def begun(q: Any) -> int:
    """The cycle at which the job's first sample stands, from the middle of the carry."""
    job = exported("ur-script").sampled
    middle = int(np.searchsorted(job.time, in_carry()))
    away = np.abs(q - job.arm(0, job.q)[middle]).max(axis=1)
    return int(np.argmin(away)) - 4 * middle


def in_carry(share: float = 0.4) -> float:
    carry = rack_job().phase("carry")
    return carry.begin + share * carry.duration


def button(number: int, arm: int, level: bool = True) -> Callable[[Pair], None]:
    return lambda pair: pair.arms[arm].buttons.__setitem__(number, level)


def protective_stop(arm: int) -> Callable[[Pair], None]:
    return lambda pair: setattr(pair.arms[arm], "stopped", True)


def sensor(arm: int) -> Callable[[Pair], None]:
    return lambda pair: setattr(pair.arms[arm], "offset", 60.0)


FAULTS: dict[str, tuple[Callable[[Pair], None], str]] = {
    "the leader's protective stop": (protective_stop(0), "the other arm is silent"),
    "the other's protective stop": (protective_stop(1), "the other arm is silent"),
    "a button": (button(2, 0), "stopped by hand"),
    "a sensor's offset": (sensor(1), "the force is out of its band"),
}


@pytest.mark.parametrize("phase", PHASES)
@pytest.mark.parametrize("name", FAULTS)
def test_both_arms_hold_and_press(name: str, phase: str) -> None:
    """Both stand, at one place but for what the heartbeat and the stop take, and press as the job
    does there."""
    fault, told = FAULTS[name]
    planned = rack_job().phase(phase)
    sheet = exported("ur-script")
    job, lift = sheet.sampled, rack_job().phases[2].begin
    at = planned.begin + 0.4 * planned.duration
    # The programs meet before the job.
    found = pair({at + 0.06: fault})
    if name == "a sensor's offset":
        if phase in ("release", "retreat"):
            assert found.run().arms[0].log[-1] == "ended", "nothing is held any more"
            return
        # It counts when the pads have to press: before they do, nothing is lifted.
        at = max(at, lift)
    found.most = at + 1.5
    found.run()
    assert any(told in arm.log for arm in found.arms)
    last = [np.array([row[1] for row in arm.record[-100:]]) for arm in found.arms]
    assert max(np.ptp(q, axis=0).max() for q in last) < 1e-9, "both stand"
    near = np.abs(job.time - at) < 0.5
    away = np.abs(job.q[near] - np.concatenate([q[-1] for q in last])).max(axis=1)
    # At most so far apart along the path they are: within the heartbeat's time-out and the stop.
    fastest = float(np.abs(job.q_rate[near]).max())
    assert away.min() <= fastest * (0.1 + sheet.stop.quick) / 2.0 + 1e-6
    newton = found.arms[sheet.follower].record[-1][2]
    force = job.normal_force[near, sheet.follower]
    assert force.min() - 0.5 <= newton <= force.max() + 0.5
    if phase in HELD:
        assert newton >= job.normal_force[job.span(2).start, sheet.follower] - 1.0
    if name == "a sensor's offset" and phase not in HELD:
        risen = job.pose[near][int(np.argmin(away)), 2] - job.pose[job.span(2).start, 2]
        assert abs(risen) < 1e-4, "nothing is lifted"


def test_a_held_job_goes_on_to_set_the_box_down() -> None:
    when = in_carry()
    at = {when: button(2, 0), when + 1.0: button(2, 0, False)}
    for arm in (0, 1):
        at[when + 1.2 + 0.3 * arm] = button(3, arm)
        at[when + 2.0 + 0.01 * arm] = button(3, arm, False)
    found = pair(at).run()
    job = exported("ur-script").sampled
    for arm, each in enumerate(found.arms):
        assert each.log[-1] == "ended", each.log
        np.testing.assert_allclose(each.q, job.arm(arm, job.q)[-1], atol=1e-6)
        q = np.array([row[1] for row in each.record])
        fastest = np.abs(job.arm(arm, job.q_rate)).max()
        assert np.abs(np.diff(q, axis=0)).max() < 1.05 * CYCLE * fastest, "no arm jumps"


def test_an_arm_elsewhere_is_not_moved_unasked() -> None:
    found = pair(away=0.1)
    found.most = 40.0
    found.run()
    assert any(line.startswith("popup Move the arm") for line in found.arms[0].log)
    assert any("program is not there" in line for line in found.arms[1].log), "and the other waits"
    for arm in found.arms:
        assert arm.log[-1] == "halt"
        assert np.ptp(np.array([row[1] for row in arm.record]), axis=0).max() < 1e-12


def test_other_arms_and_steps_are_refused() -> None:
    with pytest.raises(SettingsError, match="UR e-series"):
        TARGETS["ur-script"].refuse(rack_job(), "ur-script", any_arm=False)
    options = BundleOptions(step=0.05, any_arm=True)
    with pytest.raises(SettingsError, match="time step"):
        urscript_files(prepared(rack_driven(), TARGETS["ur-script"], options))
