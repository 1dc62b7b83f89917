"""Elements of an XML document, read attribute by attribute; every problem names its place."""

from __future__ import annotations

import re
from collections.abc import Sequence
from xml.etree import ElementTree

import numpy as np

from symbolic.array import Array, Range
from symbolic.errors import OutsideError
from symbolic.read.tables import checked_number, checked_vector
from symbolic.records.poses import read_only
from symbolic.records.problems import Problems, shown, suggestion

MOST_ELEMENTS = 100_000
MOST_ATTRIBUTES = 500_000
MAX_ELEMENT_DEPTH = 32
MOST_NAME = 200

# Python's float() takes more than that (1_000, other digits), and C readers other things (0x1p3).
_XML_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")


class _LimitedBuilder(ElementTree.TreeBuilder):
    """Builder of XML elements with limits on their number and depth."""

    def __init__(self) -> None:
        super().__init__()
        self._depth = 0
        self._count = 0

    def start(self, tag: str, attrs: dict[str, str], /) -> ElementTree.Element:
        self._depth += 1
        self._count += 1
        if self._depth > MAX_ELEMENT_DEPTH:
            raise OutsideError(f"nested too deeply; allowed is a depth of {MAX_ELEMENT_DEPTH}")
        if self._count > MOST_ELEMENTS:
            raise OutsideError(f"has more than {MOST_ELEMENTS} elements, which is the limit")
        return super().start(tag, attrs)

    def end(self, tag: str, /) -> ElementTree.Element:
        self._depth -= 1
        return super().end(tag)


def parse_elements(document: str, root_tag: str = "robot") -> ElementTree.Element:
    """Parse an XML document and return its root element.

    Args:
        document: the text.
        root_tag: tag that the root element has to have.

    Raises:
        OutsideError: the document is not XML, has too many elements, or a root with another tag.
    """
    if document.count("=") > MOST_ATTRIBUTES:
        raise OutsideError(f"has more than {MOST_ATTRIBUTES} attributes, which is the limit")
    parser = ElementTree.XMLParser(target=_LimitedBuilder())
    # The declaration may name ASCII; by now it is text.
    body = re.sub(r"^\s*<\?xml[^>]*\?>", "", document, count=1)
    lines = document[: len(document) - len(body)].count("\n")
    try:
        parser.feed(body)
        root = parser.close()
    except ElementTree.ParseError as error:
        line, column = error.position
        said = str(error).split(":")[0]
        raise OutsideError(
            f"is not readable XML: {said}, line {line + lines}, column {column}", code="not-xml"
        ) from error
    except ValueError as error:
        raise OutsideError(
            "is not readable XML: it holds characters that are none", code="not-xml"
        ) from error
    if root.tag != root_tag:
        raise OutsideError(
            f"its root is <{shown(root.tag)[1:-1]}>; allowed is <{root_tag}>", code="wrong-root"
        )
    if any("xacro}" in element.tag for element in root.iter()):
        raise OutsideError("holds xacro macros; expand it: `xacro FILE > robot.urdf`")
    return root


class ElementReader:
    """Reader of one XML element that records problems with the place of the element.

    Attributes:
        kept: copy of the element with only those attributes and inner elements that were read.

    Args:
        element: the element.
        path: place of the element, such as `link 'arm'/collision[0]`; empty for the root.
        problems: collector of problems.
    """

    def __init__(self, element: ElementTree.Element, path: str, problems: Problems) -> None:
        self.element = element
        self.path = path
        self.problems = problems
        self.kept = ElementTree.Element(element.tag)

    @property
    def tag(self) -> str:
        """Tag of the element."""
        return self.element.tag

    def at(self, key: str) -> str:
        """Return the place of the attribute `key` in the document, for messages: the place of the
        element, then the attribute's name."""
        return f"{self.path} {key}".lstrip()

    def named(self, tag: str) -> dict[str, ElementReader]:
        """Return the inner elements with a tag, by the value of their attribute `name`. A repeated
        name is recorded as a problem; the first element with it is returned."""
        found: dict[str, ElementReader] = {}
        for index, element in enumerate(self.element.findall(tag)):
            name = ElementReader(element, f"{self.path}/{tag}[{index}]".lstrip("/"), self.problems)
            if (called := name.text("name")) in found:
                self.problems.add(name.at("name"), f"found {called!r} again; names differ")
            elif called:
                found[called] = self._inner(element, f"{tag} {called!r}")
                found[called].text("name")
        return found

    def child(self, tag: str) -> ElementReader | None:
        """Return the first inner element with a tag; None if there is none."""
        element = self.element.find(tag)
        return None if element is None else self._inner(element, tag)

    def required(self, tag: str) -> ElementReader:
        """Return the first inner element with a tag.

        If it is missing, record a problem and return a reader that reports nothing further.
        """
        found = self.child(tag)
        if found is None:
            self.problems.add(self.path, f"<{tag}> is missing")
            return ElementReader(ElementTree.Element(tag), f"{self.path}/{tag}", Problems())
        return found

    def all(self, tag: str) -> list[ElementReader]:
        """Return a reader of every inner element with a tag. These elements do not become part of
        the copy `kept`."""
        path = f"{self.path}/{tag}".removeprefix("/")
        return [
            ElementReader(element, f"{path}[{index}]", self.problems)
            for index, element in enumerate(self.element.findall(tag))
        ]

    def one_of(self, tags: Sequence[str]) -> ElementReader:
        """Return the first inner element, whose tag has to be among `tags`. Otherwise record a
        problem and return a reader that reports nothing further."""
        element = next(iter(self.element), None)
        if element is None or element.tag not in tags:
            found = "nothing" if element is None else shown(element.tag)
            self.problems.add(self.path, f"found {found}; allowed is one of {', '.join(tags)}")
            return ElementReader(ElementTree.Element("none"), self.path, Problems())
        return self._inner(element, element.tag)

    def raw(self, key: str) -> str | None:
        """Return an attribute as written; None if it is missing."""
        return self.element.get(key)

    def inner_text(self, tag: str) -> str:
        """Return the text of the first inner element with a tag; '' if there is none."""
        return (self.element.findtext(tag) or "").strip()

    def text(self, key: str, most: int = MOST_NAME) -> str:
        """Read the attribute `key` as a printable text of 1 to `most` characters; '' after a
        problem."""
        value = self.raw(key)
        if value is None:
            self.problems.add(self.at(key), "is missing")
        elif not value or len(value) > most or not value.isprintable():
            self.problems.add(
                self.at(key), f"found {shown(value)}; allowed are 1 to {most} printable characters"
            )
        else:
            self.kept.set(key, value)
            return value
        return ""

    def choice(self, key: str, allowed: Sequence[str]) -> str:
        """Read the attribute `key`, one of the words in `allowed`; '' after a problem."""
        value = self.text(key)
        if value and value not in allowed:
            hint = suggestion(value, allowed)
            self.problems.add(
                self.at(key),
                f"found {shown(value)}; allowed is one of {', '.join(allowed)}{hint}",
            )
            return ""
        return value

    def number(self, key: str, allowed: Range, default: str | None = None) -> float:
        """Read an attribute as a finite number; 1 after a problem.

        Args:
            key: name of the attribute.
            allowed: range of the number.
            default: text for a missing attribute; None if it is required.
        """
        return float(self.numbers(key, (allowed,), default)[0])

    def numbers(self, key: str, allowed: Sequence[Range], default: str | None = None) -> Array:
        """Read an attribute with n numbers separated by spaces.

        Args:
            key: name of the attribute.
            allowed: ranges of the n numbers.
            default: text for a missing attribute; None if the attribute is required.

        Returns:
            Array (n,), ones after a problem.
        """
        if key in self.element.attrib:
            self.kept.set(key, self.element.attrib[key])
        return self._numbers(self.at(key), self.element.get(key, default), allowed)

    def content(self, allowed: Sequence[Range]) -> Array:
        """Read the n numbers between the element's tags, separated by spaces.

        Args:
            allowed: ranges of the numbers.

        Returns:
            Array (n,), ones after a problem.
        """
        return self._numbers(self.path, self.element.text, allowed)

    def _numbers(self, path: str, value: str | None, allowed: Sequence[Range]) -> Array:
        words = [] if value is None else value.split()
        if len(words) != len(allowed):
            count = "a number" if len(allowed) == 1 else f"{len(allowed)} numbers"
            told = f"found {shown(value)}; allowed: {count}"
            self.problems.add(path, "is missing" if value is None else told)
            return read_only(np.ones(len(allowed)))
        # A word that is no number is reported as such.
        numbers = [float(word) if _XML_NUMBER.fullmatch(word) else word for word in words]
        if len(allowed) == 1:
            return read_only([checked_number(numbers[0], allowed[0], path, self.problems)])
        return checked_vector(numbers, allowed, path, self.problems)

    def _inner(self, element: ElementTree.Element, name: str) -> ElementReader:
        found = ElementReader(element, f"{self.path}/{name}".removeprefix("/"), self.problems)
        self.kept.append(found.kept)
        return found
