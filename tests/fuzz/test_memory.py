"""The memory that reading one file takes: at most ten times its size and 300 MiB."""

from __future__ import annotations

import gzip
import io
import json
import os
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from hybrid_opt.campaign.candidates import columns
from symbolic.read.descriptions import MEMORY_BYTES, MEMORY_PER_BYTE
from symbolic.read.elements import MOST_ATTRIBUTES
from symbolic.read.meshes import MOST_WORDS
from symbolic.safe_io import MAX_JSON_VALUES, MEBIBYTE, MESH_BYTES, URDF_BYTES, WORKCELL_BYTES
from tests.symbolic.cells import ROOT
from tests.waiting import HANGS, MOST_SECONDS

ROOM = 300 * MEBIBYTE
XACRO = b'<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><link n="${1}"/>'
COLLADA = b'<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">'
TRIANGLE = (
    b"facet normal 0 0 0\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"
)
LISTED = (
    b"ply\nformat ascii 1.0\nelement vertex 900000\nproperty float x\nproperty float y\n"
    b"property float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
)
PAIR = b"<disable_collisions link1='%d' link2='b'/>"
POINT = b',{"objectives":[0,0],"parent":0,"polished":true,"x":[0,0]}'
POINTS_END = b'],"figures":{},"attempts":[]}'
MANIFEST = b'{"format": "dual-arm-carry bundle", "version": 1, "files": {"a": "a"'


def packed(n_var: int, rows: int) -> bytes:
    """Candidates of zeros, which pack a thousand times smaller."""
    names = columns(n_var, ("a", "b"))
    zeros = ",".join(["0"] * (len(names) - 3))
    content = io.BytesIO()
    with gzip.open(content, "wb", 6) as file:
        file.write(("# seconds: 1.0\n" + ",".join(names) + "\n").encode())
        for row in range(1, rows + 1):
            file.write(f"{row},1,,{zeros}\n".encode())
    return content.getvalue()


WORDS = {kind: 2 * most - 100 for kind, most in MOST_WORDS.items()}
"""Size of a text of the most words, of one letter each, by its format."""

FULL: dict[str, tuple[str, bytes, bytes, bytes, int]] = {
    "array": ("cell.toml", b"a=[", b"[],", b"]", WORKCELL_BYTES),
    "robots": ("cell.toml", b"", b"[[robots]]\n", b"", WORKCELL_BYTES),
    "lines": ("arm.urdf", b"<robot>", b"\n", b"</robot>", URDF_BYTES),
    "elements": ("arm.xacro", XACRO, b"<a/>", b"</robot>", URDF_BYTES),
    "text": ("arm.xacro", XACRO, b"x", b"</robot>", URDF_BYTES),
    "named triangles": ("m.stl", b"solid a\n", TRIANGLE, b"endsolid a\n", MESH_BYTES),
    "corners": ("m.obj", b"v 0 0 0\nf ", b"1 ", b"\n", WORDS["obj"]),
    "vertices": ("m.off", b"OFF\n900000 1 0\n", b"0 0 0\n", b"", WORDS["off"]),
    "listed vertices": ("m.ply", LISTED, b"0 0 0\n", b"3 0 1 2\n", WORDS["ply"]),
    "collada": ("m.dae", COLLADA, b"<a/>", b"</COLLADA>", 1_900_000),
    "values": ("trajectory.json", b"[", b"[],", b"1]", 3 * (MAX_JSON_VALUES // 2 - 9)),
    "letters": ("trajectory.json", b'["', b"a", b'\xf0\x9f\x98\x80"]', 100 * MEBIBYTE),
    "points": ("polish.json", b'{"front": [{}', POINT, POINTS_END, 7_000_000),
    "front": ("front.csv", b"#\n#\nh\n", b"1,1,1\n", b"", 2_000_000),
    "larger front": ("front.csv", b"#\n#\nh\n", b"1,", b"1", MESH_BYTES),
    "record": ("key.json", b'{"facts": [', b"[],", b'1], "sha256": "a"}', 1_200_000),
}
"""The file, how it begins, a piece, how it ends, and its size, for as many pieces as it takes."""

NAMED: dict[str, tuple[str, bytes, bytes, bytes, int]] = {
    "tables": ("cell.toml", b"", b"[a%x]\n", b"", 90_000),
    "attributes": ("arm.urdf", b"<robot><link ", b"a%x='' ", b"/></robot>", MOST_ATTRIBUTES - 1),
    "links": ("arm.urdf", b"<robot>", b"<link name='%d'/>", b"</robot>", 99_000),
    "pairs": ("arm.srdf", b"<robot>", PAIR, b"</robot>", 99_000),
    "configuration": ("configuration.json", b'{"a": 0', b', "%d": []', b"}", MAX_JSON_VALUES // 3),
    "manifest": ("manifest.json", MANIFEST, b', "%d": "a"', b"}}", MAX_JSON_VALUES - 10),
}
"""The same with how many pieces there are, which have a number each."""

OTHERS: dict[str, tuple[str, Callable[[], bytes]]] = {
    "triangles": ("m.stl", lambda: bytes(80) + struct.pack("<I", 10**6) + bytes(5 * 10**7)),
    "candidates": ("candidates.csv.gz", lambda: packed(18, 1_000_000)),
    "wide candidates": ("candidates.csv.gz", lambda: packed(3000, 8000)),
    "one long line": ("candidates.csv.gz", lambda: gzip.compress(b"a" * 2**29)),
}
ALWAYS = ("robots", "attributes", "corners")


def content_of(case: str) -> tuple[str, bytes]:
    """The name of a file, and what is in it."""
    if case in FULL:
        name, head, piece, tail, size = FULL[case]
        return name, head + piece * ((size - len(head) - len(tail)) // len(piece)) + tail
    if case in NAMED:
        name, head, piece, tail, count = NAMED[case]
        return name, head + b"".join(piece % k for k in range(count)) + tail
    name, content = OTHERS[case]
    return name, content()


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(case, marks=() if case in ALWAYS else pytest.mark.slow)
        for case in (*FULL, *NAMED, *OTHERS)
    ],
)
def test_reading_takes_little_memory(tmp_path: Path, case: str) -> None:
    name, content = content_of(case)
    tmp_path.chmod(0o700)  # as a cache has to be
    path, size = tmp_path / name, len(content)
    path.write_bytes(content)
    path.chmod(0o600)
    done = subprocess.run(
        [sys.executable, "-m", "tests.fuzz.reading", str(path)],
        cwd=ROOT,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        capture_output=True,
        check=True,
        timeout=HANGS,
    )
    found = json.loads(done.stdout)
    allowed = 10 * size + ROOM
    if path.suffix == ".xacro":  # what its own process may take at most
        allowed -= MEMORY_BYTES + MEMORY_PER_BYTE * size
    assert found["grown"] < allowed
    assert found["seconds"] < MOST_SECONDS
