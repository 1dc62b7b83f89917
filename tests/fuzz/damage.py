"""Damage to documents, to bytes, to trees of tables, to elements of XML; and what every reader
promises of them: a value, or one error that says what is wrong.

Every strategy gives a function from a sound document to a damaged one, so that Hypothesis can make
what fails as small as possible.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping
from typing import Any
from xml.etree import ElementTree

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from symbolic.errors import DualArmError
from tests.waiting import soon

Bytes = Callable[[bytes], bytes]
Tree = Callable[[Any], Any]

TOKENS = (
    *rb"""\ud800 \u0000 null true <a> </link> &lt; &a; <!-- --> <![CDATA[ [[a]] { } ] " '
    """.split(),
    *(b"\0", b"\xff", b"\xef\xbb\xbf", b"\n", b"\r\n", b"<!DOCTYPE a>", b"1e999", b"-inf", b"NaN"),
    *(b"${", b"}", b"$(arg", b"${1/0}", b"<xacro:if value='1'>"),
    *(b"[" * 200, b"a." * 200, b"9" * 5000, b"0x" + b"f" * 5000, b"/" * 300),
    b'<?xml version="1.0" encoding="utf-16"?>',
)

EXPRESSIONS = (
    *("${1 + 1}", "${1 / 0}", "${'x' * 10**9}", "${10**5000}", "${[]}", "${}", "${", "$$", "$("),
    *("${unknown}", "${mass}", "${float('nan')}", "${1e308 * 10}", "${python.range(9)}", "}"),
    *("$(arg tool)", "$(arg unknown)", "$(find unknown)", "$(eval 2**9)", "$(env PATH)", "$(cwd)"),
    *("${xacro.load_yaml('/dev/zero')}", "${xacro.load_yaml('.')}", "${xacro.fatal('a')}"),
)
"""What stands in the attributes of xacro files; elsewhere it is only an odd text."""

NUMBERS = (0, -0.0, 1, -1, 2, 0.5, 1e-320, 1e-12, 1e6, 1e308, -1e308, 10**30, 10**400, 2**63, 1000)
NOT_FINITE = (math.inf, -math.inf, math.nan)
TEXTS = (
    *("", " ", "a", "a\0b", "\x1b[31m", "\u202e", "x" * 5000, "../" * 40, "/dev/zero", "nan"),
    *("\U0001f600", "payload", "left", "mesh", "box", "'", '"', "\n", "1e308"),
)


def odd_values() -> st.SearchStrategy[Any]:
    """Values that may stand anywhere."""
    plain = st.one_of(
        st.sampled_from([*NUMBERS, *NOT_FINITE]),
        st.sampled_from(TEXTS),
        st.booleans(),
        st.floats(),
        st.text(max_size=10),
    )
    nested = st.one_of(
        st.lists(plain, max_size=7),
        st.dictionaries(st.sampled_from(TEXTS), plain, max_size=3),
        st.lists(st.dictionaries(st.sampled_from(["name", "kind", "size"]), plain), max_size=3),
    )
    return st.one_of(plain, nested)


@st.composite
def byte_damage(draw: st.DrawFn) -> Bytes:
    """Some pieces cut out, doubled, overwritten or put in, at places given as shares."""
    share = st.floats(0.0, 1.0)
    kinds = st.sampled_from(["cut", "double", "flip", "put", "end"])
    steps = draw(
        st.lists(
            st.tuples(kinds, share, st.integers(1, 60), st.sampled_from(TOKENS)),
            min_size=1,
            max_size=4,
        )
    )

    def damaged(content: bytes) -> bytes:
        for kind, where, length, token in steps:
            at = int(where * len(content))
            piece = content[at : at + length]
            match kind:
                case "cut":
                    content = content[:at] + content[at + length :]
                case "double":
                    content = content[:at] + piece * 3 + content[at + length :]
                case "flip":
                    turned = bytes(byte ^ (1 << length % 8) for byte in piece[:1])
                    content = content[:at] + turned + content[at + 1 :]
                case "put":
                    content = content[:at] + token + content[at:]
                case "end":
                    content = content[:at]
        return content

    return damaged


def places(tree: Any) -> list[tuple[Any, Any]]:
    """Every (container, key) of a tree of dictionaries and lists."""
    if isinstance(tree, dict):
        keys: list[Any] = list(tree)
    elif isinstance(tree, list):
        keys = list(range(len(tree)))
    else:
        return []
    return [(tree, key) for key in keys] + [place for key in keys for place in places(tree[key])]


@st.composite
def tree_damage(draw: st.DrawFn) -> Tree:
    """Some values replaced, left out, doubled, exchanged, or others put in."""
    share = st.floats(0.0, 1.0, exclude_max=True)
    kinds = st.sampled_from(["replace", "replace", "replace", "remove", "add", "swap", "repeat"])
    steps = draw(st.lists(st.tuples(kinds, share, share, odd_values()), min_size=1, max_size=3))

    def damaged(tree: Any) -> Any:
        tree = copy.deepcopy(tree)
        for kind, where, other, value in steps:
            found = places(tree)
            if not found:
                break
            inside, key = found[int(where * len(found))]
            second, second_key = found[int(other * len(found))]
            match kind:
                case "replace":
                    inside[key] = copy.deepcopy(value)
                case "remove":
                    del inside[key]
                case "add" if isinstance(inside, dict):
                    inside["added"] = copy.deepcopy(value)
                case "add":
                    inside.append(copy.deepcopy(value))
                case "swap":
                    mine, theirs = copy.deepcopy(inside[key]), copy.deepcopy(second[second_key])
                    inside[key] = theirs
                    if second is not inside or second_key != key:
                        second[second_key] = mine
                case "repeat" if isinstance(inside[key], list):
                    inside[key] = (inside[key] * 40)[:200]
        return tree

    return damaged


@st.composite
def xml_damage(draw: st.DrawFn) -> Bytes:
    """Attributes and elements of an XML document changed, left out, doubled or moved."""
    share = st.floats(0.0, 1.0, exclude_max=True)
    values = st.one_of(
        st.sampled_from([str(float(number)) for number in (*NUMBERS[:12], *NOT_FINITE)]),
        st.sampled_from([text for text in TEXTS if text.isprintable()]),
        st.floats().map(repr),
        st.lists(st.floats(-10.0, 10.0).map(repr), max_size=4).map(" ".join),
        st.sampled_from(
            ["1 2 3", "0 0 0", "1e308 0 0", "nan 0 0", "1_0", "0x1p3", "1,0", "\u0661"]
        ),
        st.sampled_from(EXPRESSIONS),
    )
    kinds = st.sampled_from(["value", "value", "value", "drop", "remove", "double", "move", "tag"])
    steps = draw(st.lists(st.tuples(kinds, share, share, values), min_size=1, max_size=3))

    def damaged(content: bytes) -> bytes:
        root = ElementTree.fromstring(content)
        for kind, where, other, value in steps:
            elements = list(root.iter())
            element = elements[int(where * len(elements))]
            names = sorted(element.attrib)
            name = names[int(other * len(names))] if names else ""
            parents = {child: parent for parent in root.iter() for child in parent}
            target = elements[int(other * len(elements))]
            match kind:
                case "value" if name:
                    element.set(name, value)
                case "drop" if name:
                    del element.attrib[name]
                case "remove" if element in parents:
                    parents[element].remove(element)
                case "double" if element in parents:
                    parents[element].append(copy.deepcopy(element))
                case "move" if element not in target.iter() and target not in element.iter():
                    target.append(copy.deepcopy(element))
                case "tag":
                    element.tag = target.tag
        return ElementTree.tostring(root)

    return damaged


# --- what readers promise ---


LONGEST_MESSAGE = 40_000
"""A hundred problems of four hundred letters."""


Checks = Mapping[str, tuple[Callable[..., None], tuple[st.SearchStrategy[Any], ...]]]
"""What is damaged, and with what, by name."""

MANY = 1000
"""Damages of one kind in the long tests."""


def all_kept(checks: Checks, kind: str, examples: int, *fixed: Any) -> None:
    """Run one check with so many examples of its strategies, behind arguments that are fixed."""
    check, strategies = checks[kind]

    def run(damage: tuple[Any, ...]) -> None:
        check(*fixed, *damage)

    limited = settings(max_examples=examples, suppress_health_check=list(HealthCheck))
    limited(given(st.tuples(*strategies))(run))()


def kept(read: Callable[[], Any], *names: str) -> Any:
    """What reading gave, or None where it was refused as promised.

    Args:
        read: reads the file; anything but a `DualArmError` goes through and fails the test.
        names: of the file, one of which a refusal has to contain.
    """
    with soon():
        try:
            return read()
        except DualArmError as error:
            said = str(error)
    assert any(name in said for name in names), said
    assert 0 < len(said) < LONGEST_MESSAGE, len(said)
    assert all(line.isprintable() for line in said.splitlines()), ascii(said)
    return None
