"""Long straight-line C in pieces that a compiler takes in linear time.

CasADi writes a function of scalars as one line of statements over as many local variables as live
at once. A compiler takes more than in proportion to its length over such a text: every variable may
conflict with every other. Cut into functions of some hundred statements, which hand the variables
that live on from one to the next by an array, the same statements run in the same order and give
the same bits.
"""

from __future__ import annotations

import re

LONG = 10_000
"""Statements from which on a function is cut: shorter ones are evaluated more often, and a seventh
faster as a whole."""

PIECE = 250
"""Statements of a piece. `force_inner_second` of the rack (45,000 statements, half of them in
lanes, -O1) took gcc 12 on a busy machine 15.2 s as a whole, 7.7 s in pieces of 1000 and 5.5 s in
pieces of 250; 56 evaluations took 199, 240 and 229 us."""

_FUNCTION = re.compile(
    r"^static int (?P<name>\w+)\(const (?P<real>\w+)\*\* arg, [^)]*\) \{\n"
    r"(?P<declared>(?:  (?P=real) a\d+(?:, a\d+)*;\n)+)"
    r"(?P<body>(?:  (?:a\d+\s*=|if \(res\[)[^\n]*\n)+)"
    r"  return 0;\n\}\n",
    re.M,
)
_VARIABLE = re.compile(r"\ba\d+\b")


def is_long(body: str) -> bool:
    """Whether a function's lines are so many that it is cut."""
    return body.count("\n") >= LONG


def in_pieces(text: str) -> str:
    """C text of CasADi functions, also of `codegen.lanes`, the long straight ones in pieces."""
    return _FUNCTION.sub(_cut, text)


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
    """Variables that a piece reads before it sets them, and those that it sets."""
    read, written = set[str](), set[str]()
    for line in piece:
        variables = _VARIABLE.findall(line)
        target = variables.pop(0) if line.startswith("  a") else None
        read.update(variable for variable in variables if variable not in written)
        if target is not None:
            written.add(target)
    return read, written
