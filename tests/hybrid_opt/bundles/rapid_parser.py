"""A parser for the part of RAPID that motion modules use, after ABB's reference manual.

It knows nothing of the exporter: it reads tokens, declarations, procedures with parameters,
conditions, assignments and calls with optional arguments (`\\Name` and `\\Name:=value`), and
returns them as plain records.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field

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
    """A module: declarations as (storage, type, name, value) and procedures by name."""

    name: str
    declarations: list[tuple[str, str, str, Value | None]] = field(default_factory=list)
    procedures: dict[str, list[Call]] = field(default_factory=dict)
    parameters: dict[str, list[tuple[str, str]]] = field(default_factory=dict)


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
        """Statements up to a closing word; what a condition holds follows it."""
        calls = []
        while self.peek() not in ends:
            if self.peek() == "IF":
                self.take()
                calls.append(Call("IF", [self.expression("THEN")]))
                calls += self.statements("ENDIF")
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
                self.statements("ENDPROC")
        self.take("ENDMODULE")
        if self.peek():
            raise RapidError(f"{self.peek()!r} after the module")
        return module


def parse(text: str) -> Module:
    """The module that a text holds."""
    return _Parser(text).module()
