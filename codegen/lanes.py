"""CasADi's C: its grammar, and its translation to lanes.

`codegen.parts` and this module read the output of CasADi's code generator. They rely on this
grammar:

  text      = helper* constant* function+ entry
  constant  = "static const casadi_real casadi_" ("c" N | "zeros") "[" N "] = {" number,* "};"
  function  = [ "/* name:(inputs)->(outputs) */" ]
              "static int casadi_f" N "(const casadi_real** arg, casadi_real** res, casadi_int* iw,
              casadi_real* w, int mem) {" body "}"
  body      = straight | calls | choice
  straight  = "casadi_real a0, a1, ...;" statement* "return 0;"            (a function of scalars)
  calls     = declarations, lines with helpers, loops and other functions  (a function of matrices)
  choice    = "if (arg[0] ? casadi_to_int(*arg[0]) : 0) {" call "} else {" call "}" "return 0;"
  entry     = "return casadi_f" N "(arg, res, iw, w, mem);"

with at most one statement on a line. `FORMS` lists the forms of a line, each with an example;
`KEPT_FORMS` those that mean the same for lanes as for numbers. In lanes (the types of
`codegen/c/lanes.h`) constants are equal in all lanes, comparisons and choices are masks, and a
branch of `casadi.Function.if_else` runs if any lane needs it. A line of any other form raises a
`FormError` with its text. A new version of CasADi, or a CasADi function that was not used before,
then needs one more entry here.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass
from math import prod

from codegen.errors import FormError

_NUMBER = r"-?(?:\d+\.?\d*(?:e[+-]?\d+)?|casadi_inf|casadi_nan|INFINITY|NAN)"
_TERM = r"(?:[aw]\d+|\(\*c[rs]\+\+\)|\*\s*c[rs]\+\+|c[rs]\[i\]|" + _NUMBER + ")"
_SIDES = rf"\(\s*({_TERM})\s*{{}}\s*({_TERM})\s*\)"

FORMS = [
    (example, re.compile(pattern, re.M), in_lanes)
    for example, pattern, in_lanes in (
        ("/* #3: @0 = (@0<@2) */", r"/\*.*?\*/", ""),
        ("a1=2.5;", rf"^(\s*[aw]\d+\s*=\s*)({_NUMBER});", r"\1lanes_all_equal(\2);"),
        (
            "*rr++ = 0.5;",
            rf"^(\s*(?:\*rr\+\+|res\[\d+\]\[\d+\])\s*=\s*)({_NUMBER});",
            r"\1lanes_all_equal(\2);",
        ),
        # Arguments with entries are always there, and branches would cut the code into blocks.
        ("a0=arg[0]? arg[0][1] : 0;", r"arg\[\d+\]\s*\? (arg\[\d+\]\[\d+\]) : 0;", r"\1;"),
        ("a0=(a0<=a1);", _SIDES.format("<="), r"lanes_le(\1, \2)"),
        ("a0=(a0<a1);", _SIDES.format("<"), r"lanes_lt(\1, \2)"),
        ("a0=(a0==a1);", _SIDES.format("=="), r"lanes_eq(\1, \2)"),
        ("a0=(a0!=a1);", _SIDES.format("!="), r"lanes_ne(\1, \2)"),
        ("a0=(a0&&a1);", _SIDES.format("&&"), r"lanes_and(\1, \2)"),
        ("a0=(a0||a1);", _SIDES.format(r"\|\|"), r"lanes_or(\1, \2)"),
        ("a0=(a0?a1:0);", rf"\(\s*({_TERM})\s*\?\s*({_TERM})\s*:\s*0\s*\)", r"lanes_if(\1, \2)"),
        ("a0=(!a0);", rf"\(\s*!\s*({_TERM})\s*\)", r"lanes_not(\1)"),
        (
            "a0=sin(a1);",
            r"\b(sqrt|sin|cos|ceil|floor|exp|log|tan|asin|acos|atan|sinh|cosh|tanh|pow|atan2|"
            r"hypot|fmod)\(",
            r"lanes_\1(",
        ),
    )
]
"""Forms that are rewritten for lanes, in order: an example, its pattern, and its replacement."""

KEPT_FORMS = [
    (example, re.compile(pattern))
    for example, pattern in (
        ("if (res[0]!=0) res[0][1]=a0;", r"if \(res\d*\[\d+\](?:!=0)?\)"),
        ("if (arg[0]) w1=arg[0];", r"if \(arg\d*\[\d+\]\)"),
        (
            "w1=arg[0] ? arg[0]+3 : casadi_zeros;",
            r"arg\[\d+\]\s*\? arg\[\d+\](?:\[\d+\]|\+\d+)? : "
            r"(?:casadi_zeros|lanes_all_equal\(0\.0\)|0)",
        ),
        (
            "for (i=0, rr=w1, cs=w2; i<4; ++i)",
            r"for \([^;]*;\s*(?:i<\d+|cs!=\(?&?w\w*\)?(?:\+\d+)?);[^;)]*\)",
        ),
    )
]
"""Forms of comparisons and choices that do not depend on numbers in lanes: an example and its
pattern."""

_WORD = re.compile(r"[A-Za-z_]\w*")
_WORDS = re.compile(
    r"^(?:const|static|int|for|if|else|return|arg\d*|res\d*|iw|w|mem|i|j|k|rr|cs|cr|"
    r"casadi_(?:real|int|zeros|copy|fill|clear|fmax|fmin|fabs|sign|sq|mtimes_dense|vfmax|vfmin|"
    r"mmax|mmin|dot|norm_2|norm_inf)|casadi_[fc]\d+|lanes_\w+|a\d+|w\d+|wr\d+|INFINITY|NAN|e)$"
)
"""Words that are valid in lanes. Apart from these a line has only arithmetic and indices."""
_COMPARES = re.compile(r"[?<>!|]|&&|==")

_CONSTANT = re.compile(
    r"^static const casadi_real casadi_(c\d+|zeros)\[(\d+)\]\s*=\s*\{(.*?)\};", re.DOTALL | re.M
)
_FUNCTION = re.compile(
    r"(?:^/\* \w+:\((?P<inputs>[^\n]*?)\)->\((?P<outputs>[^\n]*?)\) \*/\n)?"
    r"^static int casadi_(?P<name>f\d+)\([^)]*\) \{\n(?P<body>.*?)^\}\n",
    re.DOTALL | re.M,
)
_CHOICE = re.compile(
    r"  if \(arg\[0\] \? casadi_to_int\(\*arg\[0\]\) : 0\) \{\n"
    r"    if \(casadi_(f\d+)\(arg\+1, res, iw, w, 0\)\) return 1;\n"
    r"  \} else \{\n"
    r"    if \(casadi_(f\d+)\(arg\+1, res, iw, w, 0\)\) return 1;\n"
    r"  \}\n  return 0;\n$"
)
_ENTRY = re.compile(r"^\s+return casadi_(f\d+)\(arg, res, iw, w, mem\);$", re.M)


@dataclass(frozen=True)
class LaneText:
    """The C text of a function for lanes.

    Attributes:
        text: static functions and constants, with a prefix on all names.
        entry: name of the function. It takes arg, res, iw, w, mem as CasADi's functions do, over
            `lanes_real`.
    """

    text: str
    entry: str


def lane_text(generated: str, prefix: str, shared: Collection[int] = ()) -> LaneText:
    """Translate CasADi's C of one function to the lanes of `codegen/c/lanes.h`.

    Args:
        generated: CasADi's text, with CasADi's comments.
        prefix: prefix of all defined names.
        shared: indices of arguments that are passed as plain numbers, equal for all lanes; only for
            a function without nested calls.

    Raises:
        FormError: a line cannot be translated to lanes.
    """
    parts = []
    for name, size, values in _CONSTANT.findall(generated):
        entries = [value.strip() for value in values.split(",")]
        equal = ", ".join(f"LANES_CONSTANT({value})" for value in entries)
        parts.append(f"static const casadi_real casadi_{name}[{size}] = {{{equal}}};\n")
    names, entry = [], _ENTRY.search(generated)
    for found in _FUNCTION.finditer(generated):
        names.append(found["name"])
        own = shared if entry and found["name"] == entry[1] else ()
        parts.append(
            f"static int casadi_{found['name']}(const casadi_real** arg, casadi_real** res, "
            "casadi_int* iw, casadi_real* w, int mem) {\n"
            f"{_choice(found) or _lines(found, own)}}}\n"
        )
    if entry is None or entry[1] not in names:
        raise _unknown("the text", "no function that is called from outside")
    text = re.sub(r"\bcasadi_(f\d+|c\d+|zeros)\b", rf"{prefix}_\1", "".join(parts))
    return LaneText(text.replace("casadi_", "lanes_"), f"{prefix}_{entry[1]}")


def _lines(function: re.Match[str], shared: Collection[int] = ()) -> str:
    body = function["body"]
    for k in shared:
        given = re.compile(rf"arg\[{k}\]\s*\? arg\[{k}\]\[(\d+)\] : 0;")
        body = given.sub(rf"lanes_shared(arg[{k}], \1);", body)
    for _, pattern, in_lanes in FORMS:
        body = pattern.sub(in_lanes, body)
    for written, line in zip(function["body"].splitlines(), body.splitlines(), strict=True):
        rest = line
        for _, pattern in KEPT_FORMS:
            rest = pattern.sub("", rest)
        if _COMPARES.search(rest) or not all(map(_WORDS.match, _WORD.findall(rest))):
            head = function[0].partition("\n")[0] if function["outputs"] else function["name"]
            raise _unknown(head.strip("/* "), written.strip())
    return body


def _choice(function: re.Match[str]) -> str | None:
    """Translate the C of a choice between two functions (`casadi.Function.if_else`) to lanes.

    Each branch runs if at least one lane needs it, and a mask selects the lanes that keep its
    results.

    Args:
        function: the function in CasADi's text, with the groups 'body' and 'outputs'.

    Returns:
        The body in lanes; None if the function is no such choice.
    """
    branches = _CHOICE.match(function["body"])
    if branches is None or function["outputs"] is None:
        return None
    wanted, otherwise = branches.groups()
    sizes = [_size(output) for output in function["outputs"].split(",")]
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
    """Return the number of entries of a result from its description in CasADi's comment: name,
    name[3] or name[3x4]."""
    shape = re.search(r"\[(\d+)(?:x(\d+))?\]", described)
    return prod(int(length) for length in shape.groups(default="1")) if shape else 1


def _unknown(function: str, line: str) -> FormError:
    return FormError(
        f"{function}: CasADi wrote a form of C that has no form in lanes: `{line}`; compile the "
        "function with lanes=1, or add the form to codegen/lanes.py"
    )
