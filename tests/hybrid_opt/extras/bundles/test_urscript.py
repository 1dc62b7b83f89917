"""Both URScript programs, read as the Python that they nearly are, run side by side against mock
arms of Universal Robots' script manual: servoj, force mode, digital lines, threads."""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np
import pytest

from hybrid_opt.extras.bundles import BundleOptions
from hybrid_opt.extras.bundles.bundle import prepared
from hybrid_opt.extras.bundles.urscript import (
    FOLLOWED,
    normal_speed,
    require_followed,
    urscript_files,
)
from hybrid_opt.job.records import HELD_PHASES, PHASES, Job
from symbolic.array import Array
from symbolic.errors import SettingsError
from tests.hybrid_opt.extras.bundles.bundles import contents, exported, rack_driven
from tests.hybrid_opt.job.jobs import rack_job
from tests.refusals import refused

BLOCK = re.compile(r"^(\s*)(def|thread|if|while|elif|else)\b.*:$")
CYCLE = 0.002


class _Waiting(ast.NodeTransformer):
    """Functions as generators, each call of which is waited for."""

    def __init__(self, module: ast.Module) -> None:
        functions = (node for node in ast.walk(module) if isinstance(node, ast.FunctionDef))
        self._waited = {"servoj", "sync", *(node.name for node in functions)}

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        self.generic_visit(node)
        node.body[:0] = ast.parse("yield from ()").body
        return node

    def visit_Call(self, node: ast.Call) -> ast.AST:
        self.generic_visit(node)
        is_waited = isinstance(node.func, ast.Name) and node.func.id in self._waited
        return ast.YieldFrom(node) if is_waited else node


def as_python(script: str) -> ast.Module:
    """The program as Python's parser reads it: blocks end by `end`, poses are lists.

    Every `end` has to stand where the block begins that it closes.
    """
    lines: list[str] = []
    opened: list[int] = []
    for line in script.splitlines():
        code = line.split("#")[0].rstrip()
        found = BLOCK.match(code)
        if found and found[2] in ("elif", "else"):
            assert len(found[1]) == opened[-1]
        elif found:
            opened.append(len(found[1]))
        if code.strip() == "end":
            assert len(code) - len("end") == opened.pop()
            continue
        code = re.sub(r"\bp\[", "[", code)
        code = re.sub(r"^(\s*)thread ", r"\1def ", code)
        code = re.sub(r"\brun (\w+)\(\)", r"run(\1)", code)
        code = re.sub(r"^(\s*)halt$", r"\1return 'halt'", code)
        code = re.sub(r"^(\s*)kill (\w+)", r"\1kill(\2)", code)
        code = re.sub(r"^(\s*)global (\w+) = ", r'\1globals()["\2"] = ', code)
        lines.append(code)
    assert not opened
    module = ast.parse("\n".join(lines))
    _Waiting(module).visit(module)
    return ast.fix_missing_locations(module)


class Arm:
    """What a program calls; its joints follow servoj at once."""

    def __init__(self, pair: Pair, start: Array, module: ast.Module) -> None:
        self.pair, self.q = pair, np.array(start)
        self.outs, self.buttons = [False] * 8, [False] * 8
        # What the other arm sees: of the last cycle, whichever of both threads runs first.
        self.shown, self.felt = [False] * 8, 0.0
        self.newton, self.offset, self.pressed = 0.0, 0.0, False
        self.log: list[str] = []
        self.record: list[tuple[float, Array, float]] = []
        # Masses, and the force at which each was set.
        self.payload: list[tuple[float, float]] = []
        self.threads: dict[int, Iterator[None]] = {}
        self.stopped = self.ended = False
        self._rest = 0.0
        space = self._names()
        exec(compile(module, "script", "exec"), space)
        self._program = space["carry_job"]()

    @property
    def other(self) -> Arm:
        first, second = self.pair.arms
        return second if self is first else first

    def cycle(self) -> None:
        """One cycle of its program."""
        try:
            next(self._program)
        except StopIteration as end:
            self.log.append(end.value or "ended")
            self.ended = True

    def _cycles(self, seconds: float) -> int:
        self._rest += seconds / CYCLE
        whole = int(self._rest + 1e-9)
        self._rest -= whole
        return whole

    def _names(self) -> dict[str, Any]:
        def servoj(q: list[float], t: float, lookahead_time: float, gain: float) -> Iterator[None]:
            assert 0.03 <= lookahead_time <= 0.2
            assert 100 <= gain <= 2000
            assert t >= CYCLE - 1e-9
            begin, count = self.q.copy(), self._cycles(t)
            for k in range(count):
                self.q = begin + (np.array(q) - begin) * (k + 1) / count
                yield

        def sync() -> Iterator[None]:
            yield

        def force_mode(frame: Any, selection: Any, wrench: Any, kind: int, limits: Any) -> None:
            assert selection == [0, 0, 1, 0, 0, 0]
            assert kind == 2
            assert len(limits) == 6
            self.newton, self.pressed = wrench[2], True

        def end_force_mode() -> None:
            self.newton = 0.0
            self.log.append("end_force_mode")

        def told(name: str) -> Callable[..., None]:
            return lambda *given, **_: self.log.append(" ".join(map(str, (name, *given))))

        def line(number: int) -> bool:
            return self.other.shown[number] if number < 2 else self.buttons[number]

        def run(body: Callable[[], Iterator[None]]) -> int:
            self.threads[len(self.threads)] = body()
            return len(self.threads) - 1

        only_told = "force_mode_set_damping force_mode_set_gain_scaling zero_ftsensor set_tcp"
        return {name: told(name) for name in f"{only_told} popup textmsg stopj".split()} | {
            "servoj": servoj,
            "sync": sync,
            "force_mode": force_mode,
            "end_force_mode": end_force_mode,
            "set_target_payload": lambda mass, centre: self.payload.append((mass, self.newton)),
            "get_actual_joint_positions": lambda: self.q.tolist(),
            "get_actual_tcp_pose": lambda: [0.0] * 6,
            "set_standard_digital_out": self.outs.__setitem__,
            "get_standard_digital_in": line,
            "force": lambda: max(self.felt, self.other.felt) + self.offset,
            "norm": abs,
            "run": run,
            "kill": lambda number: self.threads.pop(number),
        }


class Pair:
    """Two arms in lockstep.

    Attributes:
        time: [s].
        at: what happens at which time.
        most: when it ends at the latest [s].
    """

    def __init__(
        self,
        starts: list[Array],
        at: dict[float, Callable[[Pair], None]],
        modules: list[ast.Module] | None = None,
    ) -> None:
        self.time, self.at, self.most = 0.0, dict(at), 60.0
        first, second = map(partial(Arm, self), starts, modules or programs())
        self.arms: tuple[Arm, Arm] = first, second

    def run(self) -> Pair:
        while not all(arm.ended for arm in self.arms) and self.time <= self.most:
            for arm in self._running():
                arm.cycle()
            self.time += CYCLE
            self.cycled()
            for arm in self.arms:
                arm.shown, arm.felt = list(arm.outs), arm.newton
            for when in [when for when in self.at if when <= self.time]:
                self.at.pop(when)(self)
            for thread in [each for arm in self._running() for each in arm.threads.values()]:
                next(thread, None)
            for arm in self.arms:
                arm.record.append((self.time, arm.q.copy(), arm.newton))
        return self

    def cycled(self) -> None:
        """What is wired to both arms follows their outputs."""

    def _running(self) -> list[Arm]:
        return [arm for arm in self.arms if not (arm.stopped or arm.ended)]


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
        assert found.arms[arm].log[-2:] == ["stopj 2.0", "ended"], found.arms[arm].log
        planned = job.arm(arm, job.q)
        # One point in four cycles of 2 ms.
        for k in range(1, len(planned), 50):
            # Where the first begins is known to a cycle.
            near = 1.1 * CYCLE * np.abs(job.arm(arm, job.q_rate)[k]) + 1e-5
            assert (np.abs(q[begin + 4 * k] - planned[k]) <= near).all(), k
    newton = np.array([row[2] for row in found.arms[follower].record])
    assert newton.max() == pytest.approx(job.normal_force[:, follower].max(), abs=1.0)
    # Nowhere less than the box needs while it is held, and no more than within 0.1 s of it.
    wanted, held = job.normal_force[:, follower], rack_job().held
    for k in range(len(job.time)):
        near = wanted[max(0, k - 12) : k + 13]
        assert newton[begin + 4 * k] <= near.max() + 0.5
        assert newton[begin + 4 * k] >= near.min() - 0.5
        if held[0].begin + 0.1 < job.time[k] < held[-1].begin + held[-1].duration - 0.01:
            assert newton[begin + 4 * k] >= wanted[k] - 0.5
    assert not found.arms[1 - follower].pressed
    log = found.arms[follower].log
    told = ("zero_ftsensor", "force_mode_set_damping 0.1", "end_force_mode")
    assert [line for line in log if line in told] == list(told)
    for each in found.arms:
        assert each.payload == [(0.0, 0.0)], "each change zeroes the force sensor"


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


FAULTS: dict[str, tuple[Callable[[Pair], None], str]] = {
    "the leader's protective stop": (
        lambda pair: setattr(pair.arms[0], "stopped", True),
        "the other arm is silent",
    ),
    "the other's protective stop": (
        lambda pair: setattr(pair.arms[1], "stopped", True),
        "the other arm is silent",
    ),
    "a button": (button(2, 0), "stopped by hand"),
    "a sensor's offset": (
        lambda pair: setattr(pair.arms[1], "offset", 60.0),
        "the force is out of its band",
    ),
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
    assert any(f"textmsg {told}" in arm.log for arm in found.arms)
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
    if phase in HELD_PHASES:
        assert newton >= job.normal_force[job.span(2).start, sheet.follower] - 1.0
    if name == "a sensor's offset" and phase not in HELD_PHASES:
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
    asked, waits = ([line for line in arm.log if line.startswith("popup ")] for arm in found.arms)
    assert "first position" in asked[0]
    assert "program" in waits[0], "and the other waits"
    for arm in found.arms:
        assert arm.log[-1] == "halt"
        assert np.ptp(np.array([row[1] for row in arm.record]), axis=0).max() < 1e-12


def test_steps_that_fill_no_phase_are_refused() -> None:
    options = BundleOptions(step=0.05, any_arm=True)
    with refused(SettingsError, "time-step"):
        urscript_files(prepared(rack_driven(), "ur-script", options))


def along_the_normals(speed: float) -> Job:
    """The rack's job, its box moved along the normals at a speed in the carry [m/s]."""
    job = rack_job()
    carry = job.phase("carry")
    normal = job.workcell.contacts[0].T_box_pad[:3, 2]
    pose = carry.motion.pose.copy()
    pose[:, 3:] = 0.0
    pose[:, :3] = pose[0, :3] + np.outer(carry.motion.time * speed, normal)
    moved = replace(carry, motion=replace(carry.motion, pose=pose))
    return replace(job, phases=tuple(moved if p.name == "carry" else p for p in job.phases))


def test_a_carry_along_the_normals_is_refused() -> None:
    """Force mode does not execute motion along its compliant axis."""
    require_followed(rack_job())
    assert normal_speed(along_the_normals(0.179), 0) == pytest.approx(0.179, rel=1e-6)
    require_followed(along_the_normals(0.9 * FOLLOWED))
    with pytest.raises(SettingsError, match=r" 0\.179 m/s .* 3\.6 .*torque"):
        require_followed(along_the_normals(0.179))
