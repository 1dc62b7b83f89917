"""Long functions of a C text: compiled separately, and cut into pieces.

Many texts contain the same functions: an arm's Newton steps are in every function that follows a
path, and twice if both arms are of one kind. A part is a long function that calls no other
(`straight` in the grammar of `codegen.lanes`, and functions of matrices that need no helper). Each
part has a file of its own, named by its content, so texts with the same part share one object file.
The parts of one text are compiled in parallel. Parts for lanes have their own optimisation level.

CasADi writes a scalar function (type SX) as one sequence of statements over as many local
variables as are in use at once. The compile time of such a text grows faster than its length,
because every variable may conflict with every other. So the function is cut into pieces: functions
of some hundred statements, which pass their variables to the next piece through an array. The same
statements run in the same order and give the same bits.

Text with another form stays as it is and only takes longer to compile.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

from codegen.cache import digest
from codegen.compiler import part_level

LEAST_BYTES = 8000
"""A function with at least so many bytes is compiled separately: the start of a compiler costs 0.03
s, as much as 2000 bytes."""

LEAST_ENTRY = 50_000
"""The same limit for the text's own function, which other texts rarely share [bytes]."""

_CALLED = re.compile(
    r"^static int (?P<name>\w+_f\d+)(?P<rest>\(const (?P<real>casadi|lanes)_real\*\* arg, [^)]*\) "
    r"\{\n(?P<body>(?:  [^\n]*\n)*)\}\n)",
    re.M,
)
_VARIABLE_NAME = re.compile(r"\b[A-Za-z_]\w*")
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

CUT_STATEMENTS = 16_000
"""Statements from which on a function is cut: shorter ones are evaluated more often, and faster as
a whole. Of clearances of the rack 12,800 statements took 0.78 us in lanes cut, 11,900 took 0.48 us
as a whole."""

PIECE = 250
"""Statements of a piece. `force_inner_second` of the rack (45,000 statements, half of them in
lanes, -O1) took gcc 12 on a busy machine 15.2 s as a whole, 7.7 s in pieces of 1000 and 5.5 s in
pieces of 250; 56 evaluations took 199, 240 and 229 us."""

_INCLUDE = re.compile(r'^#include "([^"]+)"$', re.MULTILINE)

_STRAIGHT = re.compile(
    r"^static int (?P<name>\w+)\(const (?P<real>\w+)\*\* arg, [^)]*\) \{\n"
    r"(?P<declared>(?:  (?P=real) a\d+(?:, a\d+)*;\n)+)"
    r"(?P<body>(?:  (?:a\d+\s*=|if \(res\[)[^\n]*\n)+)"
    r"  return 0;\n\}\n",
    re.M,
)
_VARIABLE = re.compile(r"\ba\d+\b")


@dataclass(frozen=True)
class CodePart:
    """A long function that is compiled in a file of its own.

    Attributes:
        name: name of the function, made from the content of the file.
        text: content of the file.
        level: optimisation level of the compiler, 0 to 3.
    """

    name: str
    text: str
    level: int


def in_parts(text: str, most: int = 3) -> tuple[str, tuple[CodePart, ...]]:
    """Move the long functions of a C text into separate texts, so that they compile in parallel and
    several libraries share their object files.

    Only functions that call no other one are moved. A declaration stays in their place.

    Args:
        text: C text from `codegen.source`.
        most: highest optimisation level of a moved function.

    Returns:
        The text with declarations, and the moved functions without duplicates.
    """
    before = {
        "casadi": _preamble(*(["one_lane.h"] if "dual_arm_sin" in text else []), "part.h"),
        "lanes": _preamble("one_lane.h")
        + _width(text)
        + runtime("lanes.h")
        + "#if DUAL_ARM_LANES > 1\n",
    }
    parts: dict[str, CodePart] = {}
    names: dict[str, str] = {}

    def take(found: re.Match[str]) -> str:
        kind, body = found["real"], found["body"]
        words = _OWN[kind]
        least = LEAST_ENTRY if found["name"].endswith("_f0") else LEAST_BYTES
        if len(body) < least or not all(words.match(w) for w in set(_VARIABLE_NAME.findall(body))):
            return found[0]
        content = in_pieces(f"static int part_f0{found['rest']}")
        content = content.replace("static int part_f0(", "int PART(")
        after = "#endif\n" if kind == "lanes" else ""
        name = f"dual_arm_{digest(before[kind], content)[:32]}"
        whole = f"{before[kind]}#define PART {name}\n{content}{after}"
        level = part_level(len(body), kind == "lanes")
        # Long functions with lanes are evaluated in batches; one by one they only check that lanes
        # are right.
        hardly_used = kind == "casadi" and "dual_arm_run_lanes" in text and is_long(body)
        parts[name] = CodePart(name, whole, 0 if hardly_used else min(level, most))
        names[found["name"]] = name
        return f"int PART_{found['name']}{found['rest'].split(' {', 1)[0]};\n"

    text = _CALLED.sub(take, text)
    text = re.sub(
        r"^#define (\w+) CASADI_PREFIX\(f\d+\)\n",
        lambda found: "" if found[1] in names else found[0],
        text,
        flags=re.M,
    )
    text = re.sub(r"\b(?:PART_)?(\w+_f\d+)\b", lambda found: names.get(found[1], found[0]), text)
    return text, tuple(parts.values())


def _width(text: str) -> str:
    """Return the line of a C text that defines the number of lanes; '' if the text takes the
    machine's width or has no lanes. The line stands directly before the text of `lanes.h`."""
    before = text.partition(runtime("lanes.h"))[0]
    stated = re.search(r"^#define DUAL_ARM_LANES \d+\n\Z", before, re.M)
    return stated[0] if stated else ""


@cache
def runtime(name: str) -> str:
    """Return the text of a file of `codegen/c`, the runtime around generated functions, with its
    includes inserted."""
    text = files("codegen").joinpath("c", name).read_text()
    return _INCLUDE.sub(lambda found: runtime(found[1]), text)


def _preamble(*runtimes: str) -> str:
    return "".join(["#include <math.h>\n", *map(runtime, ("arithmetic.h", *runtimes))])


def is_long(body: str) -> bool:
    """Return True if the body of a C function has so many statements that `in_pieces` cuts it, at
    least `CUT_STATEMENTS`."""
    return body.count("\n") >= CUT_STATEMENTS


def in_pieces(text: str) -> str:
    """Cut the long functions of a C text into pieces of some hundred statements, which compile
    faster.

    Only straight-line functions are cut, with lanes or without. The same statements run in the same
    order.
    """
    return _STRAIGHT.sub(_cut, text)


def _cut(found: re.Match[str]) -> str:
    if not is_long(found["body"]):
        return found[0]
    statements = found["body"].splitlines()
    name, real = found["name"], found["real"]
    pieces = [statements[at : at + PIECE] for at in range(0, len(statements), PIECE)]
    used = [_used(piece) for piece in pieces]
    slots = {variable: k for k, variable in enumerate(_VARIABLE.findall(found["declared"]))}
    alive: set[str] = set()
    texts = []
    for k in reversed(range(len(pieces))):
        read, written = used[k]
        kept = sorted(written & alive)
        alive = (alive - written) | read
        lines = [
            f"static __attribute__((noinline)) void {name}_{k}"
            f"(const {real}** arg, {real}** res, {real}* kept) {{",
            f"  {real} {', '.join(sorted(read | written))};" if read | written else "",
            *[f"  {v}=kept[{slots[v]}];" for v in sorted(read)],
            *pieces[k],
            *[f"  kept[{slots[v]}]={v};" for v in kept],
            "}\n",
        ]
        texts.append("\n".join(lines))
    calls = "".join(f"  {name}_{k}(arg, res, kept);\n" for k in range(len(pieces)))
    head = found[0][: found.start("declared") - found.start()]
    whole = f"{head}  {real} kept[{len(slots)}];\n{calls}  return 0;\n}}\n"
    return "".join([*reversed(texts), whole])


def _used(piece: list[str]) -> tuple[set[str], set[str]]:
    """Return two sets of names of variables in some lines of C: those that are read before they are
    set, and those that are set."""
    read, written = set[str](), set[str]()
    for line in piece:
        variables = _VARIABLE.findall(line)
        target = variables.pop(0) if line.startswith("  a") else None
        read.update(variable for variable in variables if variable not in written)
        if target is not None:
            written.add(target)
    return read, written
