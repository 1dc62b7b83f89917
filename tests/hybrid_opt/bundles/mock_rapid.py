"""RAPID's motion modules read as the Python that they nearly are, and a stand-in for the controller
that runs both tasks, after ABB's reference manual and the manual of Force Control (FC Pressure).

Procedures are generators: instructions take their time cycle by cycle. The controller runs each
task by itself; they wait for one another only where they say so. Robots follow at once, along
straight lines of the joints (MoveAbsJ) or of the pad (FCPressL). Force rises by `FORCE_RATE`, and
stays as it was when a task ends.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation, Slerp

from symbolic.array import Array
from symbolic.records import Workcell
from symbolic.records.poses import inverse
from symbolic.robot.model import build_robot_model

CYCLE = 0.004
"""Of the controller [s]."""

FORCE_RATE = 100.0
"""Change of a force that is built up [N/s]."""

LONGEST_NAME = 32

DECLARED = re.compile(r"(VAR|PERS|CONST) (\w+) (\w+)(?:\{(\d+)\})?(?: := (.+))?")

OPTION = re.compile(r",?\s*\\(\w+)(?::=([^,\\]+))?")

HANDLER = "  except TimeoutError:"

VALUES = {name: name for name in ("fine", "v5", "v1000", "z15", "load0", "ERR_WAITSYNCTASK")}
VALUES["ERRNO"] = "ERR_WAITSYNCTASK"
"""What a controller knows by itself, as far as modules use it."""


@dataclass
class Module:
    """A module: by name how something is stored, its type and its value (None where none is given),
    and its procedures as Python."""

    declared: dict[str, tuple[str, str, Any]]
    procedures: dict[str, str]


def parse(text: str) -> Module:
    """The module that a text holds, one statement per line."""
    declared: dict[str, tuple[str, str, Any]] = {}
    procedures: dict[str, list[str]] = {}
    body, depth = list[str](), 0
    for line in text.splitlines():
        code = re.sub(r'("[^"]*")|!.*', lambda found: found[1] or "", line).strip()
        unquoted = re.sub(r'"[^"]*"', "", code)
        assert all(len(word) <= LONGEST_NAME for word in re.findall(r"\w+", unquoted)), code
        begun = re.fullmatch(r"PROC (\w+)\(\)", code)
        condition = re.fullmatch(r"IF (.+) THEN", code)
        if begun:
            body, depth = procedures.setdefault(begun[1], []), 2
            body += [f"def {begun[1]}():", f"  begun('{begun[1]}')", "  try:", "    yield from ()"]
        elif code in ("ERROR", "ENDPROC"):
            assert depth == 2, "what a condition holds ends within its procedure"
            if HANDLER not in body:
                body.append(HANDLER)
            if code == "ENDPROC":
                body.append("    raise")
                depth = 0
        elif condition:
            compared = condition[1].replace("<>", "!=")
            compared = re.sub(r"(?<![<>!=])=", "==", compared).replace("Abs", "abs")
            body.append(f"{'  ' * depth}if {compared}:")
            depth += 1
        elif code == "ENDIF":
            depth -= 1
        elif code and code.split()[0] not in ("MODULE", "ENDMODULE"):
            assert code.endswith(";"), code
            stated = DECLARED.fullmatch(code[:-1])
            if stated is None:
                assert depth >= 2, code
                body.append("  " * depth + _statement(code[:-1]))
            elif not depth:
                value = eval(stated[5] or "None", {"TRUE": True, "FALSE": False})
                assert stated[4] is None or len(value) == int(stated[4]), code
                declared[stated[3]] = stated[1], stated[2], value
    return Module(declared, {name: "\n".join(lines) for name, lines in procedures.items()})


def _statement(code: str) -> str:
    """An assignment, or an instruction with optional arguments (`\\Name` and `\\Name:=value`)."""
    if re.match(r"\w+ :=", code):
        return code.replace(":=", "=")
    name, _, rest = code.partition(" ")
    options = [f"{option}={value or True}" for option, value in OPTION.findall(rest)]
    given = OPTION.sub("", rest).strip(", ")
    return f"yield from {name}({', '.join(filter(None, [given, *options]))})"


class Exit(Exception):
    """`EXIT`, or an error that nothing handles; the message is the error's."""


class Task:
    """One task with its robot; public methods with capital letters are instructions.

    Attributes:
        q: joints [rad].
        force: that the pad presses with; negative where it is drawn off [N].
        log: what it wrote, and why it ended.
        runs: whether it still does.
    """

    def __init__(self, cell: Controller, arm: int, module: Module, q: Array) -> None:
        self.arm, self.q, self.force = arm, q.copy(), 0.0
        self.log: list[str] = []
        self.runs, self._spare = True, 0.0
        self._cell, self._module = cell, module
        self._robot = cell.workcell.robots[arm]
        self._model = build_robot_model(self._robot)
        self._data = self._model.model.createData()
        self._names: dict[str, Any] = dict(VALUES)
        for name, (_, kind, value) in module.declared.items():
            self._names[name] = _target(value) if kind == "jointtarget" else value
            if kind == "tooldata":
                self._names[name] = SimpleNamespace(tload=value[2])
            elif kind == "syncident":
                self._names[name] = name
        self._names |= {name: getattr(self, name) for name in dir(self) if name[0].isupper()}
        self._names |= {
            "CJointT": lambda: _target([np.rad2deg(self.q).tolist(), []]),
            "begun": lambda name: cell.begins.__setitem__(name, cell.now),
        }
        exec("\n".join(module.procedures.values()), self._names)
        self._body = self._names["Carry"]()

    def set(self, name: str, value: float) -> None:
        """Change a PERS, as someone at the pendant does."""
        assert self._module.declared[name][0] == "PERS"
        self._names[name] = value

    def cycle(self) -> None:
        """One cycle."""
        if self.runs:
            try:
                next(self._body)
            except StopIteration:
                self._ended("done")
            except (Exit, TimeoutError) as error:
                self._ended(str(error) or "EXIT")

    def _ended(self, told: str) -> None:
        self.runs = False
        self.log.append(told)

    def TPWrite(self, text: str) -> Iterator[None]:
        self.log.append(text)
        yield from ()

    def EXIT(self) -> Iterator[None]:
        raise Exit
        yield

    def ConfL(self, Off: bool) -> Iterator[None]:
        yield from ()

    def FCCalib(self, load: Any) -> Iterator[None]:
        yield from ()

    GripLoad = FCCalib

    def WaitTime(self, seconds: float) -> Iterator[None]:
        yield from self._moved(seconds, lambda x: None)

    def WaitSyncTask(self, ident: str, tasks: Any, InPos: bool, TimeOut: float) -> Iterator[None]:
        begin = self._cell.now
        self._cell.met.setdefault(ident, set()).add(self.arm)
        while len(self._cell.met[ident]) < len(tasks):
            if self._cell.now - begin > TimeOut:
                raise TimeoutError(ident)
            yield

    def _moved(self, seconds: float, change: Callable[[float], None]) -> Iterator[None]:
        """Let a move take its time; moves follow one another to less than a cycle."""
        begin = self._cell.now - self._spare
        while self._cell.now + CYCLE <= begin + seconds + 1e-12:
            change((self._cell.now + CYCLE - begin) / seconds)
            yield
        self._spare = self._cell.now - begin - seconds
        change(1.0)

    def MoveAbsJ(
        self, target: Any, speed: Any, zone: str, tool: Any, NoEOffs: bool, T: float
    ) -> Iterator[None]:
        begin, end = self.q.copy(), np.deg2rad(np.array(target[0], dtype=float))

        def change(x: float) -> None:
            self.q = begin + x * (end - begin)

        yield from self._moved(T, change)

    def FCPress1LStart(
        self, place: Any, speed: Any, threshold: float, *given: Any, Fz: float, **supervised: Any
    ) -> Iterator[None]:
        newton = self._cell.sign * Fz
        if newton < 0.0:
            raise Exit("the robot is farther from its path than PosSupvDist")
        yield from self._pressed(threshold / 100.0 * newton)
        yield from self.FCPressL(place, speed, newton, WObj=supervised["WObj"])
        yield from self._pressed(newton)

    def FCPressEnd(self, *given: Any, DeactOnly: bool, WObj: Any) -> Iterator[None]:
        yield from self._pressed(0.0)

    def _pressed(self, newton: float) -> Iterator[None]:
        begin = self.force

        def change(x: float) -> None:
            self.force = begin + x * (newton - begin)

        yield from self._moved(max(CYCLE, abs(newton - begin) / FORCE_RATE), change)

    def FCPressL(
        self, place: Any, speed: Any, newton: float, *given: Any, WObj: Any
    ) -> Iterator[None]:
        """The pad along a line of its work object to a robtarget, with a force."""
        v, spin = (5.0, 500.0) if speed == "v5" else speed[:2]
        T = _frame(WObj[3]) @ _frame(WObj[4]) @ _frame(place)
        first = self._pad()
        turn = Rotation.from_matrix(np.array([first[:3, :3], T[:3, :3]]))
        way = 1e3 * float(np.linalg.norm(T[:3, 3] - first[:3, 3]))
        angle = float(np.rad2deg((turn[0].inv() * turn[1]).magnitude()))
        path = Slerp([0.0, 1.0], turn)

        def change(x: float) -> None:
            wanted = np.eye(4)
            wanted[:3, :3] = path(min(x, 1.0)).as_matrix()
            wanted[:3, 3] = first[:3, 3] + x * (T[:3, 3] - first[:3, 3])
            self._reach(wanted)
            most = FORCE_RATE * 5.0 * CYCLE
            self.force += float(np.clip(newton - self.force, -most, most))

        yield from self._moved(max(way / v, angle / spin), change)

    def _pad(self) -> Array:
        pin.framesForwardKinematics(self._model.model, self._data, self.q)
        flange = self._data.oMf[self._model.flange_id].homogeneous
        return np.asarray(flange @ self._robot.T_flange_pad)

    def _reach(self, wanted: Array) -> None:
        """Newton's method to a place of the pad, in the robot's base."""
        T = wanted @ inverse(self._robot.T_flange_pad)
        for _ in range(3):
            pin.framesForwardKinematics(self._model.model, self._data, self.q)
            here = self._data.oMf[self._model.flange_id]
            error = pin.log6(here.actInv(pin.SE3(T))).vector
            J = pin.computeFrameJacobian(
                self._model.model, self._data, self.q, self._model.flange_id, pin.LOCAL
            )
            self.q = self.q + np.linalg.solve(J, error)


class Controller:
    """Both tasks of a MultiMove controller.

    Attributes:
        now: [s].
        sign: with which sign of Fz force control moves the pad forward.
        record: per cycle the time, both robots' joints side by side, the pressing pad's force.
        begins: when a task entered a procedure last [s].
    """

    def __init__(self, workcell: Workcell, texts: list[str], q: Array, sign: int = 1) -> None:
        self.workcell, self.now, self.sign = workcell, 0.0, sign
        self.met: dict[str, set[int]] = {}
        self.begins: dict[str, float] = {}
        first = len(workcell.robots[0].torque_max)
        parts = (q[:first], q[first:])
        self.tasks = [Task(self, arm, parse(text), parts[arm]) for arm, text in enumerate(texts)]
        self.record: list[tuple[float, Array, float]] = []

    def rounded(self, move: float) -> tuple[Array, Array, Array]:
        """Time (n,), joints (n, all) and force (n,) where zones are half a move wide: each corner
        between moves of a duration [s] is a parabola."""
        time, q, force = (np.array(column) for column in zip(*self.record, strict=True))
        width = round(move / CYCLE / 2.0)
        padded = np.pad(q, ((width, width), (0, 0)), mode="edge")
        kernel = np.full(2 * width + 1, 1.0 / (2 * width + 1))
        smooth = [np.convolve(column, kernel, mode="valid") for column in padded.T]
        return time, np.column_stack(smooth), force

    def run(self, at: dict[float, Callable[[Controller], None]] | None = None) -> Controller:
        """Until both tasks have ended; what happens at which time."""
        events = dict(at or {})
        while any(task.runs for task in self.tasks):
            for when in [when for when in events if when <= self.now]:
                events.pop(when)(self)
            for task in self.tasks:
                task.cycle()
            self.now += CYCLE
            q = np.concatenate([task.q for task in self.tasks])
            self.record.append((self.now, q, max(task.force for task in self.tasks)))
        return self


def _target(value: Any) -> SimpleNamespace:
    """A jointtarget with its components."""
    axes = {f"rax_{k}": angle for k, angle in enumerate(value[0], 1)}
    return SimpleNamespace(robax=SimpleNamespace(**axes))


def _frame(pose: Any) -> Array:
    """A transform of a RAPID pose [m]."""
    T = np.eye(4)
    w, x, y, z = (float(value) for value in pose[1])
    T[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
    T[:3, 3] = [1e-3 * float(value) for value in pose[0]]
    return T
