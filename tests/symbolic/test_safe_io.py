"""What comes from outside is read with limits, and replaced in one step."""

from __future__ import annotations

import json
import math
import os
import socket
import tomllib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from symbolic import safe_io
from symbolic.errors import OutsideError
from symbolic.safe_io import replace_file
from tests.refusals import refused
from tests.waiting import soon

MOST = 1000


def test_a_regular_file_comes_in_also_through_links(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"content")
    (tmp_path / "link").symlink_to(path)
    (tmp_path / "second").symlink_to(tmp_path / "link")
    assert safe_io.read_bytes(path, MOST) == b"content"
    assert safe_io.read_bytes(tmp_path / "second", MOST) == b"content"
    assert safe_io.resolved(tmp_path / "second") == path.resolve()


def test_the_limit_is_exact(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"x" * MOST)
    assert len(safe_io.read_bytes(path, MOST)) == MOST
    path.write_bytes(b"x" * (MOST + 1))
    for refuse in (safe_io.read_bytes, safe_io.require):
        with refused(OutsideError, "too-large"):
            refuse(path, MOST)


def test_a_file_that_hides_its_size_is_read_no_further() -> None:
    maps = Path("/proc/self/maps")
    assert maps.stat().st_size == 0
    with refused(OutsideError, "too-large"):
        safe_io.read_bytes(maps, 10)
    assert safe_io.read_bytes(maps, 10_000_000)


def test_what_is_no_regular_file_is_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(tmp_path / "socket"))
        (tmp_path / "loop").symlink_to(tmp_path / "loop")
        odd = [
            (tmp_path / "pipe", "no-regular-file"),
            (Path("/dev/zero"), "no-regular-file"),
            (tmp_path, "no-regular-file"),
            (tmp_path / "socket", "unreadable"),
            (tmp_path / "loop", "unreadable"),
            (tmp_path / "gone", "unreadable"),
            (tmp_path / ("x" * 5000), "unreadable"),
            (tmp_path / "a\0b", "unreadable"),
        ]
        for path, code in odd:
            with soon(), refused(OutsideError, code):
                safe_io.read_bytes(path, MOST)
    for path in (tmp_path / "loop", tmp_path / "gone", tmp_path / ("x" * 5000)):
        with refused(OutsideError, "unreadable"):
            safe_io.resolved(path)


values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=20,
)


@given(values, st.booleans())
def test_json_comes_in_as_written(value: Any, ascii_only: bool) -> None:
    content = json.dumps(value, ensure_ascii=ascii_only).encode()
    assert safe_io.json_value(content) == value


@given(st.binary(max_size=200))
def test_any_bytes_are_a_value_or_refused(content: bytes) -> None:
    for read in (safe_io.json_value, safe_io.toml_tables):
        with suppress(OutsideError):
            read(content)


@given(values)
def test_the_depth_is_that_of_the_value(value: Any) -> None:
    def depth(one: Any) -> int:
        if isinstance(one, dict):
            return 1 + max(map(depth, one.values()), default=0)
        if isinstance(one, list):
            return 1 + max(map(depth, one), default=0)
        return 0

    nested = value
    for _ in range(safe_io.MAX_NESTING - depth(value)):
        nested = [nested]
    assert safe_io.json_value(json.dumps(nested).encode()) == nested
    with refused(OutsideError, "too-deep", 51, 50):
        safe_io.json_value(json.dumps([nested]).encode())


JSON: list[tuple[bytes, str]] = [
    (b"", "not-json"),
    (b"{", "not-json"),
    (b"NaN", "not-json"),
    (b"[1e400]", "not-json"),
    (b"-Infinity", "not-json"),
    (b"9" * 5000, "not-json"),
    (b'"\\ud800"', "half-surrogate"),
    (b'{"\\udfff": 1}', "half-surrogate"),
    (b'[[{"a": "x\\uD800y"}]]', "half-surrogate"),
    (b"[" * 100_000, "too-deep"),
    (b"[" + b"0," * safe_io.MAX_JSON_VALUES + b"0]", "too-many-values"),
    (b"[" + b'"",' * 100 + b'"\xff"]', "not-utf-8"),
]
TOML: list[tuple[bytes, str]] = [
    (b"a = ", "not-toml"),
    (b"\xef\xbb\xbfa = 1", "byte-order-mark"),
    (b"a.b = 1\na = 2", "not-toml"),
    (b"a = " + b"9" * 5000, "not-toml"),
    (b"a = " + b"[" * 100_000, "too-deep"),
    (b"a = " + b"[" * 60 + b"]" * 60, "too-deep"),
    (b"a" + b".a" * 100_000 + b" = 1", "too-deep"),
    (b"[" + b'"a" . ' * 100_000 + b"a]", "too-deep"),
    (b"x = {" + b"'a'." * 60 + b"a = 1}", "too-deep"),
]
XML: list[tuple[bytes, str]] = [
    ('<a b="\xe9"/>'.encode("latin-1"), "not-utf-8"),
    ('<?xml version="1.0" encoding="utf-16"?><a/>'.encode("utf-16"), "not-utf-8"),
    (b'<?xml version="1.0" encoding="utf-7"?>+ADw-!DOCTYPE a+AD4-<a/>', "encoding"),
    (b"<!DOCTYPE a><a/>", "document-type"),
]


@pytest.mark.parametrize(
    ("read", "content", "code"),
    [
        *((safe_io.json_value, *case) for case in JSON),
        *((safe_io.toml_tables, *case) for case in TOML),
        *((safe_io.xml_text, *case) for case in XML),
    ],
)
def test_what_is_no_such_document_is_refused(
    read: Callable[[bytes], Any], content: bytes, code: str
) -> None:
    with soon(), refused(OutsideError, code):
        read(content)


def test_whole_surrogate_pairs_and_escaped_ones_are_text() -> None:
    assert safe_io.json_value(b'"\\ud83d\\ude00"') == "\U0001f600"
    assert safe_io.json_value(b'"\\\\ud800"') == "\\ud800"


def test_toml_comes_in_as_a_plain_reader_has_it() -> None:
    content = b"# " + b"a.b, " * 100 + b"\nx = [" + b"0.1, " * 1000 + b"]\na.b.c = '...'\n"
    found = safe_io.toml_tables(content)
    assert found == tomllib.loads(content.decode())
    assert math.isclose(sum(found["x"]), 100.0)


@pytest.mark.parametrize(
    "content",
    [
        b"a = [" + b'".", ' * 1000 + b"]",
        b"a = [" + b"'.', " * 1000 + b"]",
        b'a = """' + b"a." * 100 + b'"""',
        b"a = '''\n" + b"a." * 100 + b"'''",
        b'a = "\\"' + b"a." * 100 + b'"',
        b'a = 1 # "' + b"a." * 100 + b"\nb = 2",
        b"a." * 49 + b"a = 1",
    ],
)
def test_dots_in_texts_are_no_keys(content: bytes) -> None:
    assert safe_io.toml_tables(content) == tomllib.loads(content.decode())


def test_xml_comes_in_without_its_mark() -> None:
    document = '<?xml version="1.0" encoding="UTF-8"?><a b="\xe9"/>'
    assert safe_io.xml_text(document.encode("utf-8-sig")) == document


def test_content_and_permissions_are_those_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "file"
    replace_file(path, b"long content")
    replace_file(path, b"short", 0o600)
    assert path.read_bytes() == b"short"
    assert path.stat().st_mode & 0o777 == 0o600
    assert os.listdir(tmp_path) == ["file"]


def test_a_failure_leaves_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "file"
    replace_file(path, b"old")

    def full(handle: int) -> None:
        raise OSError("full")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="full"):
        replace_file(path, b"new")
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["file"]


def test_what_a_killed_process_left_is_overwritten(tmp_path: Path) -> None:
    (tmp_path / ".file.draft").write_bytes(b"half of something much longer")
    replace_file(tmp_path / "file", b"whole")
    assert (tmp_path / "file").read_bytes() == b"whole"
    assert os.listdir(tmp_path) == ["file"]


def test_a_link_in_place_of_the_draft_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "other").write_bytes(b"other")
    (tmp_path / ".file.draft").symlink_to(tmp_path / "other")
    with pytest.raises(OSError, match=r"\.file\.draft"):
        replace_file(tmp_path / "file", b"new")
    assert (tmp_path / "other").read_bytes() == b"other"


def test_many_writers_leave_one_content_whole(tmp_path: Path) -> None:
    path = tmp_path / "file"
    contents = [bytes([65 + k]) * (1000 + 7777 * k) for k in range(8)]
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda content: replace_file(path, content), 25 * contents))
    assert path.read_bytes() in contents
    assert os.listdir(tmp_path) == ["file"]


def test_a_missing_folder_is_told(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        replace_file(tmp_path / "none" / "file", b"")
