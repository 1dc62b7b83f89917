"""CasADi's C as C for numbers in lanes: the same functions on vectors, one evaluation per lane.

The text that CasADi writes has few forms. Those whose meaning for lanes is known are rewritten
over the types of `codegen/c/lanes.h`: constants become equal in all lanes, comparisons and choices
become masks, and a branch of `casadi.Function.if_else` runs where any lane wants it. A text with
anything else is not taken (`lane_text` returns None): its function runs one evaluation at a time.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from math import prod

_NUMBER = r"-?(?:\d+\.?\d*(?:e[+-]?\d+)?|casadi_inf|casadi_nan|INFINITY|NAN)"
_TERM = r"(?:[aw]\d+|\(\*c[rs]\+\+\)|\*\s*c[rs]\+\+|c[rs]\[i\]|" + _NUMBER + ")"

_CONSTANT = re.compile(
    r"^static const casadi_real casadi_(c\d+|zeros)\[(\d+)\]\s*=\s*\{(.*?)\};", re.DOTALL | re.M
)
_FUNCTION = re.compile(
    r"(?:^/\* \w+:\((?P<inputs>[^\n]*?)\)->\((?P<outputs>[^\n]*?)\) \*/\n)?"
    r"^static int casadi_(?P<name>f\d+)\([^)]*\) \{\n(?P<body>.*?)^\}\n",
    re.DOTALL | re.M,
)
_SWITCH = re.compile(
    r"  if \(arg\[0\] \? casadi_to_int\(\*arg\[0\]\) : 0\) \{\n"
    r"    if \(casadi_(f\d+)\(arg\+1, res, iw, w, 0\)\) return 1;\n"
    r"  \} else \{\n"
    r"    if \(casadi_(f\d+)\(arg\+1, res, iw, w, 0\)\) return 1;\n"
    r"  \}\n  return 0;\n$"
)

_REWRITES = [
    (re.compile(pattern, re.M), replacement)
    for pattern, replacement in (
        (r"/\*.*?\*/", ""),
        (rf"^(\s*[aw]\d+\s*=\s*)({_NUMBER});", r"\1lanes_all_equal(\2);"),
        (rf"^(\s*(?:\*rr\+\+|res\[\d+\]\[\d+\])\s*=\s*)({_NUMBER});", r"\1lanes_all_equal(\2);"),
        (r"\? (arg\[\d+\]\[\d+\]) : 0;", r"? \1 : lanes_all_equal(0.0);"),
        (rf"\(\s*({_TERM})\s*<=\s*({_TERM})\s*\)", r"lanes_le(\1, \2)"),
        (rf"\(\s*({_TERM})\s*<\s*({_TERM})\s*\)", r"lanes_lt(\1, \2)"),
        (rf"\(\s*({_TERM})\s*==\s*({_TERM})\s*\)", r"lanes_eq(\1, \2)"),
        (rf"\(\s*({_TERM})\s*!=\s*({_TERM})\s*\)", r"lanes_ne(\1, \2)"),
        (rf"\(\s*({_TERM})\s*&&\s*({_TERM})\s*\)", r"lanes_and(\1, \2)"),
        (rf"\(\s*({_TERM})\s*\|\|\s*({_TERM})\s*\)", r"lanes_or(\1, \2)"),
        (rf"\(\s*({_TERM})\s*\?\s*({_TERM})\s*:\s*0\s*\)", r"lanes_if(\1, \2)"),
        (rf"\(\s*!\s*({_TERM})\s*\)", r"lanes_not(\1)"),
        (
            r"\b(sqrt|sin|cos|ceil|floor|exp|log|tan|asin|acos|atan|sinh|cosh|tanh|pow|atan2|"
            r"hypot|fmod)\(",
            r"lanes_\1(",
        ),
    )
]

# What may be left after the rewriting, besides arithmetic on numbers in lanes.
_KNOWN = re.compile(
    r"^(?:const|static|int|for|if|else|return|arg\d*|res\d*|iw|w|mem|i|j|k|rr|cs|cr|"
    r"casadi_(?:real|int|zeros|copy|fill|clear|fmax|fmin|fabs|sign|sq|mtimes_dense|vfmax|vfmin|"
    r"mmax|mmin|dot|norm_2|norm_inf)|casadi_[fc]\d+|lanes_\w+|a\d+|w\d+|wr\d+|INFINITY|NAN|e)$"
)
_WORD = re.compile(r"[A-Za-z_]\w*")
_SCALAR_CONDITION = re.compile(
    r"if \(res\d*\[\d+\](?:!=0)?\)|if \(arg\d*\[\d+\]\)|"
    r"arg\[\d+\]\s*\? arg\[\d+\](?:\[\d+\]|\+\d+)? : (?:casadi_zeros|lanes_all_equal\(0\.0\)|0)|"
    r"for \([^;]*;\s*(?:i<\d+|cs!=\(?&?w\w*\)?(?:\+\d+)?);[^;)]*\)"
)


@dataclass(frozen=True)
class LaneText:
    """A function's C for lanes.

    Attributes:
        text: static functions and constants, all names with the prefix that was asked for.
        entry: name of the function: arg, res, iw, w, mem as CasADi's, over `lanes_real`.
    """

    text: str
    entry: str


def lane_text(generated: str, prefix: str) -> LaneText | None:
    """What CasADi generated for one function, over `codegen/c/lanes.h`; None if it cannot be.

    Args:
        generated: CasADi's text, with its own comments.
        prefix: begins the names of everything defined.
    """
    parts = []
    for name, size, values in _CONSTANT.findall(generated):
        entries = [value.strip() for value in values.split(",")]
        equal = ", ".join(f"LANES_CONSTANT({value})" for value in entries)
        parts.append(f"static const casadi_real casadi_{name}[{size}] = {{{equal}}};\n")
    names = []
    for found in _FUNCTION.finditer(generated):
        body = _switch(found) or _straight(found["body"])
        if body is None:
            return None
        names.append(found["name"])
        parts.append(
            f"static int casadi_{found['name']}(const casadi_real** arg, casadi_real** res, "
            f"casadi_int* iw, casadi_real* w, int mem) {{\n{body}}}\n"
        )
    entry = re.search(r"^\s+return casadi_(f\d+)\(arg, res, iw, w, mem\);$", generated, re.M)
    if entry is None or entry[1] not in names:
        return None
    text = re.sub(r"\bcasadi_(f\d+|c\d+|zeros)\b", rf"{prefix}_\1", "".join(parts))
    return LaneText(text.replace("casadi_", "lanes_"), f"{prefix}_{entry[1]}")


def _straight(body: str) -> str | None:
    for pattern, replacement in _REWRITES:
        body = pattern.sub(replacement, body)
    for line in body.splitlines():
        rest = _SCALAR_CONDITION.sub("", line)
        if re.search(r"[?<>!|]|&&|==", re.sub(r"if \(casadi_f\d+\(.*\)\)", "", rest)):
            return None
        if not all(_KNOWN.match(word) for word in _WORD.findall(rest)):
            return None
    return body


def _switch(found: re.Match[str]) -> str | None:
    """`casadi.Function.if_else`: each branch runs if a lane wants it, and its lanes are taken."""
    branches = _SWITCH.match(found["body"])
    if branches is None or found["outputs"] is None:
        return None
    wanted, otherwise = branches.groups()
    sizes = [_size(output) for output in found["outputs"].split(",")]
    call = "if (casadi_{}(arg+1, {}, iw, w, 0)) return 1;\n"
    lines = [
        "  unsigned bits = arg[0] ? lanes_bits(lanes_true(*arg[0])) : 0;\n",
        "  if (bits == LANES_FULL) { " + call.format(wanted, "res"),
        "  } else { " + call.format(otherwise, "res"),
        "  if (bits) {\n",
    ]
    # A function's res goes on behind its results: it is lent, with these results exchanged.
    for k, size in enumerate(sizes):
        lines.append(f"    casadi_real other{k}[{max(size, 1)}], *kept{k} = res[{k}];\n")
        lines.append(f"    if (kept{k}) res[{k}] = other{k};\n")
    lines.append("    " + call.format(wanted, "res"))
    for k, size in enumerate(sizes):
        lines.append(
            f"    res[{k}] = kept{k};\n    lanes_merge(bits, other{k}, {size}, kept{k});\n"
        )
    return "".join(lines) + "  }}\n  return 0;\n"


def _size(described: str) -> int:
    """Entries of a result as CasADi's comment describes it: name, name[3] or name[3x4]."""
    shape = re.search(r"\[(\d+)(?:x(\d+))?\]", described)
    return prod(int(length) for length in shape.groups(default="1")) if shape else 1
