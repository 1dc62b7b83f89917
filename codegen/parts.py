"""C text in parts: what is long and calls nothing is compiled apart, once wherever it occurs.

The same functions stand in many texts: an arm's Newton steps in everything that follows a path,
and twice where both arms are of one kind. A part is named by its content, so that texts which hold
it share one object file, which a cache keeps beside the libraries. Parts of one text are compiled
side by side, and those that are written for lanes at a level of their own.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol, TypeVar

from codegen.cache import FORMAT, Cache, digest
from codegen.compiler import FLAGS, LANE_FLAGS, Compiler, part_level
from codegen.pieces import in_pieces, is_long
from codegen.runtime import runtime

LEAST_BYTES = 8000
"""Bytes of a function from which on it is compiled apart: a compiler's start costs 0.03 s, as much
as 2000 bytes."""

LEAST_ENTRY = 50_000
"""The same of a text's own function, which others hardly share."""

_FUNCTION = re.compile(
    r"^static int (?P<name>\w+_f\d+)(?P<rest>\(const (?P<real>casadi|lanes)_real\*\* arg, [^)]*\) "
    r"\{\n(?P<body>(?:  [^\n]*\n)*)\}\n)",
    re.M,
)
_WORD = re.compile(r"\b[A-Za-z_]\w*")
_OWN = {
    "casadi": re.compile(
        r"^(?:casadi_(?:real|int|inf|sq|fmax|fmin|fabs|sign)|a\d+|w\d+|arg|res|if|return|e|sqrt|"
        r"sin|cos|tan|exp|log|asin|acos|atan|sinh|cosh|tanh|pow|atan2|ceil|floor|fmod|INFINITY)$"
    ),
    "lanes": re.compile(
        r"^(?:lanes_(?!zeros$)\w*[a-z]|lanes_atan2|a\d+|w\d+|arg|res|if|return|e|INFINITY)$"
    ),
}
"""Words of a function that a part knows: those of `codegen/c/part.h` and `codegen/c/lanes.h`."""

T = TypeVar("T")


class Submit(Protocol):
    """Runs work in turn."""

    def __call__(self, work: Callable[[], T], /) -> Future[T]:
        """Begin once what was given earlier has begun."""


@dataclass(frozen=True)
class Part:
    """A function in a file of its own.

    Attributes:
        name: of the function, by the content of the file.
        text: the file.
        level: optimisation level.
    """

    name: str
    text: str
    level: int


def in_parts(text: str, lanes: int) -> tuple[str, tuple[Part, ...]]:
    """C text of `codegen.source` or `codegen.program` with declarations in place of its parts, and
    the parts, each once.

    Args:
        lanes: of the text; 0 for what suits the machine.
    """
    before = {
        "casadi": _preamble(*(["one_lane.h"] if "dual_arm_sin" in text else []), "part.h"),
        "lanes": _preamble("one_lane.h")
        + (f"#define DUAL_ARM_LANES {lanes}\n" if lanes else "")
        + runtime("lanes.h")
        + "#if DUAL_ARM_LANES > 1\n",
    }
    parts: dict[str, Part] = {}
    names: dict[str, str] = {}

    def take(found: re.Match[str]) -> str:
        kind, body = found["real"], found["body"]
        words = _OWN[kind]
        least = LEAST_ENTRY if found["name"].endswith("_f0") else LEAST_BYTES
        if len(body) < least or not all(words.match(w) for w in set(_WORD.findall(body))):
            return found[0]
        content = in_pieces(f"static int part_f0{found['rest']}")
        content = content.replace("static int part_f0(", "int PART(")
        after = "#endif\n" if kind == "lanes" else ""
        name = f"dual_arm_{digest(before[kind], content)[:32]}"
        whole = f"{before[kind]}#define PART {name}\n{content}{after}"
        level = part_level(len(body), kind == "lanes")
        # What is long and has lanes is evaluated in batches; one by one it only tells whether lanes
        # are right.
        hardly_used = kind == "casadi" and "dual_arm_run_lanes" in text and is_long(body)
        parts[name] = Part(name, whole, 0 if hardly_used else level)
        names[found["name"]] = name
        return f"int PART_{found['name']}{found['rest'].split(' {', 1)[0]};\n"

    text = _FUNCTION.sub(take, text)
    text = re.sub(
        r"^#define (\w+) CASADI_PREFIX\(f\d+\)\n",
        lambda found: "" if found[1] in names else found[0],
        text,
        flags=re.M,
    )
    text = re.sub(r"\b(?:PART_)?(\w+_f\d+)\b", lambda found: names.get(found[1], found[0]), text)
    return text, tuple(parts.values())


@dataclass(frozen=True)
class Objects:
    """A text whose parts are being compiled.

    Attributes:
        rest: what is left of the text.
        parts: the object files to be.
        compiler: that compiles them.
    """

    rest: str
    parts: tuple[Future[Path], ...]
    compiler: Compiler

    def link(self, source: Path, library: Path, level: int, flags: tuple[str, ...]) -> None:
        """Write the rest as a C file, compile it, and put all together.

        Raises:
            CodegenError: it or a part cannot be compiled or kept.
        """
        source.write_text(self.rest)
        parts = [part.result() for part in self.parts]
        self.compiler.compile(source, library, level, flags, parts)


def compile_parts(
    rest: str,
    parts: Sequence[Part],
    compiler: Compiler,
    cache: Cache,
    submit: Submit,
) -> Objects:
    """Begin to compile the parts of a text.

    Args:
        rest, parts: as `in_parts` gives them.
        submit: see `codegen.compilation.compile_source`.
    """
    longest_first = sorted(parts, key=lambda part: -len(part.text))
    futures = [submit(partial(_object, part, compiler, cache)) for part in longest_first]
    return Objects(rest, tuple(futures), compiler)


def _object(part: Part, compiler: Compiler, cache: Cache) -> Path:
    """A part's object file, from the cache where it was compiled before."""
    key = digest(
        "part", str(FORMAT), compiler.identity, str(part.level), *FLAGS, *LANE_FLAGS, part.text
    )

    def make(result: Path) -> dict[str, Any]:
        source = result.with_name(f"{part.name}.c")
        source.write_text(part.text)
        compiler.compile(source, result, part.level, LANE_FLAGS, None)
        return {}

    found = cache.find(key)
    if found is None:
        with cache.lock(key):
            found = cache.find(key) or cache.store(key, make, ".o")
    return found.library


def _preamble(*runtimes: str) -> str:
    return "".join(["#include <math.h>\n", *map(runtime, ("arithmetic.h", *runtimes))])
