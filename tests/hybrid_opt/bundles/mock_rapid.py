"""A parser for the part of RAPID that motion modules use, and a stand-in for the controller that
runs both tasks, after ABB's reference manual and the manual of Force Control (FC Pressure).

The parser knows nothing of the exporter: it reads tokens, declarations, procedures with parameters,
conditions, assignments and calls with optional arguments (`\\Name` and `\\Name:=value`), and
returns them as plain records.

The controller runs each task by itself; they wait for one another only where they say so. Robots
follow at once, along straight lines of the joints (MoveAbsJ) or of the pad (FCPressL). Force rises
by `FORCE_RATE`, and stays as it was when a task ends.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation, Slerp

from symbolic.array import Array
from symbolic.records import Workcell
from symbolic.records.poses import inverse
from symbolic.robot.model import build_robot_model

Value = float | str | list["Value"]

_TOKEN = re.compile(
    r"(?P<space>[ \t\r\n]+)|(?P<comment>![^\n]*)|(?P<text>\"(?:[^\"\n]|\"\")*\")"
    r"|(?P<number>[-+]?\d+(?:\.\d+)?(?:E[-+]?\d+)?)|(?P<word>[A-Za-z][A-Za-z0-9_]*)"
    r"|(?P<mark>:=|<>|<=|>=|[\[\]{},;\\().<>=+*/-])"
)
_RESERVED = {
    *("MODULE", "ENDMODULE", "PROC", "ENDPROC", "ERROR"),
    *("VAR", "PERS", "CONST", "IF", "ENDIF"),
}
MAX_NAME = 32


class RapidError(Exception):
    """The text is not RAPID."""


@dataclass
class Call:
    """An instruction: its name, positional arguments and, per argument, the optional ones."""

    name: str
    arguments: list[Value] = field(default_factory=list)
    optional: dict[str, Value] = field(default_factory=dict)


@dataclass
class Module:
    """A module: declarations as (storage, type, name, value), procedures and their error handlers
    by name."""

    name: str
    declarations: list[tuple[str, str, str, Value | None]] = field(default_factory=list)
    procedures: dict[str, list[Call]] = field(default_factory=dict)
    parameters: dict[str, list[tuple[str, str]]] = field(default_factory=dict)
    handlers: dict[str, list[Call]] = field(default_factory=dict)


class _Parser:
    def __init__(self, text: str) -> None:
        self.tokens: list[tuple[str, str]] = []
        position = 0
        while position < len(text):
            match = _TOKEN.match(text, position)
            if match is None:
                raise RapidError(f"unexpected {text[position]!r} at {position}")
            kind = str(match.lastgroup)
            if kind not in ("space", "comment"):
                self.tokens.append((kind, match.group()))
            position = match.end()
        self.at = 0

    def peek(self, ahead: int = 0) -> str:
        place = self.at + ahead
        return self.tokens[place][1] if place < len(self.tokens) else ""

    def take(self, expected: str = "") -> str:
        found = self.peek()
        if not found or (expected and found != expected):
            raise RapidError(f"expected {expected!r}, found {found!r}")
        self.at += 1
        return found

    def name(self) -> str:
        kind, found = self.tokens[self.at]
        if kind != "word" or found in _RESERVED or len(found) > MAX_NAME:
            raise RapidError(f"{found!r} is no name")
        self.at += 1
        return found

    def value(self) -> Value:
        kind, found = self.tokens[self.at]
        if found == "[":
            self.take()
            items = [self.value()]
            while self.peek() == ",":
                self.take()
                items.append(self.value())
            self.take("]")
            return items
        self.at += 1
        if kind == "number":
            return float(found)
        if kind == "text":
            return found[1:-1]
        if kind == "word":
            # A component, or a product.
            while self.peek() in (".", "*"):
                found += self.take() + self.take()
            return found
        raise RapidError(f"{found!r} is no value")

    def expression(self, end: str) -> str:
        """Tokens up to one that ends an expression, whose brackets have to fit."""
        found, open_brackets = [], 0
        while self.peek() != end:
            token = self.take()
            open_brackets += (token == "(") - (token == ")")
            if token in (";", ":=") or token in _RESERVED or open_brackets < 0:
                raise RapidError(f"{token!r} in an expression")
            found.append(token)
        if open_brackets or not found:
            raise RapidError(f"expected an expression before {end!r}")
        self.take(end)
        return " ".join(found)

    def call(self) -> Call:
        call = Call(self.name())
        self._options(call)
        while self.peek() != ";":
            if call.arguments or call.optional:
                self.take(",")
            given = len(call.optional)
            self._options(call)
            if len(call.optional) > given and self.peek() in (",", ";"):
                continue
            call.arguments.append(self.value())
            self._options(call)
        self.take(";")
        return call

    def _options(self, call: Call) -> None:
        while self.peek() == "\\":
            self.take()
            option = self.name()
            if option in call.optional:
                raise RapidError(f"\\{option} given twice")
            call.optional[option] = True if self.peek() != ":=" else self._assigned()

    def _assigned(self) -> Value:
        self.take(":=")
        return self.value()

    def statements(self, *ends: str) -> list[Call]:
        """Statements up to a closing word; what a condition holds follows it, up to ENDIF."""
        calls = []
        while self.peek() not in ends:
            if self.peek() == "IF":
                self.take()
                calls.append(Call("IF", [self.expression("THEN")]))
                calls += [*self.statements("ENDIF"), Call("ENDIF")]
            elif self.peek(1) == ":=":
                target = self.name()
                self.take(":=")
                calls.append(Call(":=", [target, self.expression(";")]))
            else:
                calls.append(self.call())
        self.take()
        return calls

    def declared(self) -> tuple[str, str, str, Value | None]:
        storage, kind, name = self.take(), self.name(), self.name()
        if self.peek() == "{":
            self.take()
            size = self.value()
            self.take("}")
            value: Value | None = self._assigned()
            if not isinstance(value, list) or len(value) != size:
                raise RapidError(f"{name} has not {size} entries")
        else:
            value = self._assigned() if self.peek() == ":=" else None
        self.take(";")
        return storage, kind, name, value

    def module(self) -> Module:
        self.take("MODULE")
        module = Module(self.name())
        while self.peek() in ("VAR", "PERS", "CONST"):
            module.declarations.append(self.declared())
        while self.peek() == "PROC":
            self.take()
            name = self.name()
            self.take("(")
            module.parameters[name] = []
            while self.peek() != ")":
                module.parameters[name].append((self.name(), self.name()))
            self.take(")")
            while self.peek() == "VAR":
                self.declared()
            module.procedures[name] = self.statements("ENDPROC", "ERROR")
            if self.peek(-1) == "ERROR":
                module.handlers[name] = self.statements("ENDPROC")
        self.take("ENDMODULE")
        if self.peek():
            raise RapidError(f"{self.peek()!r} after the module")
        return module


def parse(text: str) -> Module:
    """The module that a text holds."""
    return _Parser(text).module()


CYCLE = 0.004
"""Of the controller [s]."""

FORCE_RATE = 100.0
"""Change of a force that is built up [N/s]."""


class Exit(Exception):
    """`EXIT`, or an error that nothing handles; the message is the error's."""


class Task:
    """One task with its robot.

    Attributes:
        q: joints [rad].
        force: that the pad presses with; negative where it is drawn off [N].
        load: half of the box that the controller knows of [kg].
        log: what it wrote, and why it ended.
        runs: whether it still does.
    """

    def __init__(self, cell: Controller, arm: int, module: Module, q: Array) -> None:
        self.arm, self.q, self.force, self.load = arm, q.copy(), 0.0, 0.0
        self.log: list[str] = []
        self.runs, self._spare = True, 0.0
        self._cell, self._module = cell, module
        self._robot = cell.workcell.robots[arm]
        self._model = build_robot_model(self._robot)
        self._data = self._model.model.createData()
        self._names: dict[str, Any] = {"abs": abs, "ERR_WAITSYNCTASK": "ERR_WAITSYNCTASK"}
        for _, kind, name, value in module.declarations:
            self._names[name] = _target(value) if kind == "jointtarget" else value
        self._names["CJointT"] = lambda: _target([np.rad2deg(self.q).tolist(), []])
        self._body = self._run("Carry")

    def set(self, name: str, value: float) -> None:
        """Change a PERS, as someone at the pendant does."""
        assert any(s == "PERS" and n == name for s, _, n, _ in self._module.declarations)
        self._names[name] = value

    def cycle(self) -> None:
        """One cycle."""
        if self.runs:
            try:
                next(self._body)
            except StopIteration:
                self._ended("done")
            except Exit as error:
                self._ended(str(error) or "EXIT")

    def _ended(self, told: str) -> None:
        self.runs = False
        self.log.append(told)

    def _run(self, name: str) -> Iterator[None]:
        self._cell.begins[name] = self._cell.now
        try:
            yield from self._statements(self._module.procedures[name])
        except TimeoutError:
            self._names["ERRNO"] = "ERR_WAITSYNCTASK"
            yield from self._statements(self._module.handlers.get(name, []))
            raise Exit("ERR_WAITSYNCTASK") from None

    def _statements(self, calls: list[Call]) -> Iterator[None]:
        skipping = False
        for call in calls:
            if skipping or call.name == "ENDIF":
                skipping = skipping and call.name != "ENDIF"
            elif call.name == "IF":
                skipping = not self._value(call.arguments[0])
            elif call.name == ":=":
                self._names[str(call.arguments[0])] = self._value(call.arguments[1])
            elif call.name in self._module.procedures:
                yield from self._run(call.name)
            else:
                yield from getattr(self, f"_{call.name}")(call)

    def _value(self, text: Any) -> Any:
        """What an expression of RAPID comes to."""
        if not isinstance(text, str):
            return text
        spoken = text.replace("<>", "!=").replace("Abs", "abs").replace(" . ", ".")
        return eval(re.sub(r"(?<![<>!=])=", "==", spoken), {}, self._names)

    def _TPWrite(self, call: Call) -> Iterator[None]:
        self.log.append(str(call.arguments[0]))
        yield from ()

    def _EXIT(self, call: Call) -> Iterator[None]:
        raise Exit
        yield

    def _ConfL(self, call: Call) -> Iterator[None]:
        yield from ()

    _FCCalib = _ConfL

    def _GripLoad(self, call: Call) -> Iterator[None]:
        load = self._names.get(str(call.arguments[0]), [0.0])
        self.load = float(load[0])
        yield from ()

    def _WaitTime(self, call: Call) -> Iterator[None]:
        yield from self._moved(float(str(call.arguments[0])), lambda x: None)

    def _WaitSyncTask(self, call: Call) -> Iterator[None]:
        ident = str(call.arguments[0])
        begin = self._cell.now
        self._cell.met.setdefault(ident, set()).add(self.arm)
        while len(self._cell.met[ident]) < 2:
            if self._cell.now - begin > float(str(call.optional["TimeOut"])):
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

    def _MoveAbsJ(self, call: Call) -> Iterator[None]:
        robax: Any = call.arguments[0]
        begin, end = self.q.copy(), np.deg2rad(np.array(robax[0], dtype=float))

        def change(x: float) -> None:
            self.q = begin + x * (end - begin)

        yield from self._moved(float(str(call.optional["T"])), change)

    def _FCPress1LStart(self, call: Call) -> Iterator[None]:
        place, _, threshold = call.arguments[:3]
        newton = self._cell.sign * float(self._value(call.optional["Fz"]))
        if newton < 0.0:
            raise Exit("the robot is farther from its path than PosSupvDist")
        yield from self._pressed(float(str(threshold)) / 100.0 * newton)
        yield from self._line(place, call, newton)
        yield from self._pressed(newton)

    def _pressed(self, newton: float) -> Iterator[None]:
        begin = self.force

        def change(x: float) -> None:
            self.force = begin + x * (newton - begin)

        yield from self._moved(max(CYCLE, abs(newton - begin) / FORCE_RATE), change)

    def _FCPressL(self, call: Call) -> Iterator[None]:
        yield from self._line(call.arguments[0], call, float(str(call.arguments[2])))

    def _FCPressEnd(self, call: Call) -> Iterator[None]:
        assert "DeactOnly" in call.optional
        yield from self._pressed(0.0)

    def _line(self, place: Any, call: Call, newton: float) -> Iterator[None]:
        """The pad along a line of its work object to a robtarget, with a force."""
        speed: Any = call.arguments[1]
        v, spin = (5.0, 500.0) if isinstance(speed, str) else (float(x) for x in speed[:2])
        wobj = self._names["carryGrip"]
        T = _frame(wobj[3]) @ _frame(wobj[4]) @ _frame(place)
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
