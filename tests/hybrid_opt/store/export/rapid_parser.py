"""A parser for the part of RAPID that motion modules use, after ABB's reference manual.

It knows nothing of the exporter: it reads tokens, declarations, procedures and calls with
optional arguments (`\\Name` and `\\Name:=value`), and returns them as plain records.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field

Value = float | str | list["Value"]

_TOKEN = re.compile(
    r"(?P<space>[ \t\r\n]+)|(?P<comment>![^\n]*)|(?P<text>\"(?:[^\"\n]|\"\")*\")"
    r"|(?P<number>[-+]?\d+(?:\.\d+)?(?:E[-+]?\d+)?)|(?P<word>[A-Za-z][A-Za-z0-9_]*)"
    r"|(?P<mark>:=|[\[\]{},;\\()])"
)
_RESERVED = {"MODULE", "ENDMODULE", "PROC", "ENDPROC", "VAR", "PERS", "CONST"}
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

    def peek(self) -> str:
        return self.tokens[self.at][1] if self.at < len(self.tokens) else ""

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
            return found
        raise RapidError(f"{found!r} is no value")

    def call(self) -> Call:
        call = Call(self.name())
        while self.peek() != ";":
            if call.arguments:
                self.take(",")
            call.arguments.append(self.value())
            while self.peek() == "\\":
                self.take()
                option = self.name()
                if option in call.optional:
                    raise RapidError(f"\\{option} given twice")
                call.optional[option] = True if self.peek() != ":=" else self._assigned()
        self.take(";")
        return call

    def _assigned(self) -> Value:
        self.take(":=")
        return self.value()

    def module(self) -> Module:
        self.take("MODULE")
        module = Module(self.name())
        while self.peek() in ("VAR", "PERS", "CONST"):
            storage, kind, name = self.take(), self.name(), self.name()
            if self.peek() == "{":
                self.take()
                self.value()
                self.take("}")
            value = self._assigned() if self.peek() == ":=" else None
            self.take(";")
            module.declarations.append((storage, kind, name, value))
        while self.peek() == "PROC":
            self.take()
            name = self.name()
            self.take("(")
            self.take(")")
            calls = []
            while self.peek() != "ENDPROC":
                calls.append(self.call())
            self.take("ENDPROC")
            module.procedures[name] = calls
        self.take("ENDMODULE")
        if self.peek():
            raise RapidError(f"{self.peek()!r} after the module")
        return module


def parse(text: str) -> Module:
    """The module that a text holds."""
    return _Parser(text).module()
