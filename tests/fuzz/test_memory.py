"""The memory that reading one file takes: at most ten times its size and 300 MiB."""

from __future__ import annotations

import gzip
import io
import json
import os
import struct
import subprocess
import sys
import zlib
from collections.abc import Callable
from pathlib import Path

import pytest

from hybrid_opt.campaign.journal import columns
from symbolic.outside import MEBIBYTE, MESH_BYTES, MOST_VALUES, URDF_BYTES, WORKCELL_BYTES
from symbolic.read.descriptions import MEMORY_BYTES, MEMORY_PER_BYTE
from symbolic.read.elements import MOST_ATTRIBUTES
from symbolic.read.meshes import MOST_WORDS
from tests.symbolic.cells import ROOT
from tests.waiting import HANGS, MOST_SECONDS

ROOM = 300 * MEBIBYTE
XACRO = b'<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><link n="${1}"/>'
COLLADA = b'<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">'


def full(head: bytes, piece: bytes, tail: bytes, size: int) -> bytes:
    """As many pieces as there is room for."""
    return head + piece * ((size - len(head) - len(tail)) // len(piece)) + tail


def named(begin: bytes, piece: bytes, end: bytes, count: int) -> bytes:
    """Pieces with a number each."""
    return begin + b"".join(piece % k for k in range(count)) + end


def packed(n_var: int, rows: int) -> bytes:
    """Candidates of zeros, which pack a thousand times smaller."""
    names = columns(n_var, ("a", "b"))
    zeros = ",".join(["0"] * (len(names) - 4))
    content = io.BytesIO()
    with gzip.open(content, "wb", 6) as file:
        file.write((",".join(names) + "\n").encode())
        for row in range(1, rows + 1):
            file.write(f"{row},1,1,,{zeros}\n".encode())
    return content.getvalue()


def journal(*payloads: bytes, times: int = 1) -> bytes:
    blocks = (struct.pack("<II", len(one), zlib.crc32(one)) + one for one in payloads)
    return b"DACARRY1" + b"\0" * 32 + b"".join(blocks) * times


WORDS = {kind: 2 * most - 100 for kind, most in MOST_WORDS.items()}
"""Size of a text of the most words, of one letter each, by its format."""

FILES: dict[str, tuple[str, str, Callable[[], bytes]]] = {
    "array": ("workcell", "c.toml", lambda: full(b"a=[", b"[],", b"]", WORKCELL_BYTES)),
    "tables": ("workcell", "c.toml", lambda: named(b"", b"[a%x]\n", b"", 90_000)),
    "robots": ("workcell", "c.toml", lambda: full(b"", b"[[robots]]\n", b"", WORKCELL_BYTES)),
    "attributes": (
        "urdf",
        "a.urdf",
        lambda: named(b"<robot><link ", b"a%x='' ", b"/></robot>", MOST_ATTRIBUTES - 1),
    ),
    "lines": ("urdf", "a.urdf", lambda: full(b"<robot>", b"\n", b"</robot>", URDF_BYTES)),
    "links": (
        "urdf",
        "a.urdf",
        lambda: named(b"<robot>", b"<link name='%d'/>", b"</robot>", 99_000),
    ),
    "elements": ("xacro", "a.xacro", lambda: full(XACRO, b"<a/>", b"</robot>", URDF_BYTES)),
    "text": ("xacro", "a.xacro", lambda: full(XACRO, b"x", b"</robot>", URDF_BYTES)),
    "pairs": (
        "srdf",
        "a.srdf",
        lambda: named(
            b"<robot>", b"<disable_collisions link1='%d' link2='b'/>", b"</robot>", 99_000
        ),
    ),
    "triangles": (
        "mesh",
        "m.stl",
        lambda: b"\0" * 80 + struct.pack("<I", 10**6) + b"\0" * 5 * 10**7,
    ),
    "named triangles": (
        "mesh",
        "m.stl",
        lambda: full(
            b"solid a\n",
            b"facet normal 0 0 0\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\n"
            b"endloop\nendfacet\n",
            b"endsolid a\n",
            MESH_BYTES,
        ),
    ),
    "corners": ("mesh", "m.obj", lambda: full(b"v 0 0 0\nf ", b"1 ", b"\n", WORDS["obj"])),
    "vertices": (
        "mesh",
        "m.off",
        lambda: full(b"OFF\n900000 1 0\n", b"0 0 0\n", b"", WORDS["off"]),
    ),
    "listed vertices": (
        "mesh",
        "m.ply",
        lambda: full(
            b"ply\nformat ascii 1.0\nelement vertex 900000\nproperty float x\nproperty float y\n"
            b"property float z\nelement face 1\nproperty list uchar int vertex_indices\n"
            b"end_header\n",
            b"0 0 0\n",
            b"3 0 1 2\n",
            WORDS["ply"],
        ),
    ),
    "collada": ("mesh", "m.dae", lambda: full(COLLADA, b"<a/>", b"</COLLADA>", 1_900_000)),
    "values": ("trajectory", "t.json", lambda: b"[" + b"[]," * (MOST_VALUES // 2 - 9) + b"1]"),
    "letters": (
        "trajectory",
        "t.json",
        lambda: b'["' + b"a" * 100 * MEBIBYTE + "\U0001f600".encode() + b'"]',
    ),
    "configuration": (
        "configuration",
        "configuration.json",
        lambda: named(b'{"a": 0', b', "%d": []', b"}", MOST_VALUES // 3),
    ),
    "checksums": (
        "replica",
        "replica.json",
        lambda: named(
            b'{"algorithm": "a", "replica": 0, "evaluations": 1, "seconds": 1, "sha256": {"a": "a"',
            b', "%d": "a"',
            b"}}",
            MOST_VALUES - 10,
        ),
    ),
    "points": (
        "polish",
        "polish.json",
        lambda: full(
            b'{"front": [{}',
            b',{"objectives":[0,0],"parent":0,"polished":true,"x":[0,0]}',
            b'],"figures":{},"attempts":[]}',
            7_000_000,
        ),
    ),
    "candidates": ("evaluations", "e.csv.gz", lambda: packed(18, 1_000_000)),
    "wide candidates": ("evaluations", "e.csv.gz", lambda: packed(3000, 8000)),
    "one long line": ("evaluations", "e.csv.gz", lambda: gzip.compress(b"a" * 2**29)),
    "many blocks": ("journal", "journal.bin", lambda: journal(b"\0" * 12, times=2_000_000)),
    "one block": ("journal", "journal.bin", lambda: journal(b"\0" * 100 * MEBIBYTE)),
    "manifest": (
        "manifest",
        "manifest.json",
        lambda: named(
            b'{"format": "dual-arm-carry bundle", "version": 1, "files": {"a": "a"',
            b', "%d": "a"',
            b"}}",
            MOST_VALUES - 10,
        ),
    ),
    "front": ("reference front", "r.csv", lambda: full(b"#\n#\nh\n", b"1,1,1\n", b"", 2_000_000)),
    "larger front": (
        "reference front",
        "r.csv",
        lambda: full(b"#\n#\nh\n", b"1,", b"1", MESH_BYTES),
    ),
    "record": (
        "cache",
        "k.json",
        lambda: b'{"facts": [' + b"[]," * 400_000 + b'1], "sha256": "a"}',
    ),
}
ALWAYS = ("robots", "attributes", "corners")


@pytest.mark.parametrize(
    "case",
    [pytest.param(case, marks=() if case in ALWAYS else pytest.mark.slow) for case in FILES],
)
def test_reading_takes_little_memory(tmp_path: Path, case: str) -> None:
    kind, name, content = FILES[case]
    tmp_path.chmod(0o700)  # as a cache has to be
    path = tmp_path / name
    path.write_bytes(content())
    path.chmod(0o600)
    size = path.stat().st_size
    done = subprocess.run(
        [sys.executable, "-m", "tests.fuzz.reading", kind, str(path)],
        cwd=ROOT,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        capture_output=True,
        check=True,
        timeout=HANGS,
    )
    found = json.loads(done.stdout)
    allowed = 10 * size + ROOM
    if kind == "xacro":  # what its own process may take at most
        allowed -= MEMORY_BYTES + MEMORY_PER_BYTE * size
    assert found["grown"] < allowed
    assert found["seconds"] < MOST_SECONDS
