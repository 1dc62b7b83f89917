"""Damaged trajectory files: read and unpacked soundly, or refused."""

from __future__ import annotations

import hashlib
import json
import tempfile
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import strategies as st

from hybrid_opt.store.trajectory_file import read_trajectory, write_trajectory
from tests.fuzz.damage import Bytes, Tree, byte_damage, tree_damage
from tests.fuzz.promises import MANY, Checks, all_kept, kept
from tests.symbolic.cells import rack_cell

FEW = 40


@cache
def sound() -> bytes:
    """A trajectory of the rack as it is stored."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "trajectory.json"
        cell = rack_cell()
        figures = {"duration": 5.25, "objective_peak_force_1": 0.43}
        write_trajectory(path, cell, cell.task.initial.ravel(), figures, {"seed": 7, "of": ["a"]})
        return path.read_bytes()


def judged(content: bytes) -> None:
    """Whatever the content is: a sound trajectory, or a refusal that names the file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "odd.json"
        path.write_bytes(content)
        stored = kept(lambda: read_trajectory(path), str(path))
        if stored is None:
            return
        assert np.isfinite(stored.x).all()
        assert len(stored.start) == 2
        assert all(np.isfinite(q).all() and q.ndim == 1 for q in stored.start)
        json.dumps([dict(stored.figures), dict(stored.provenance)], allow_nan=False).encode("utf-8")
        words = ("stored", "decision", "start", "cell")
        workcell = kept(lambda: stored.unpack(Path(folder) / "cell"), *words)
        if workcell is not None:
            assert workcell.digest == stored.cell.digest


def in_bytes(damaged: Bytes) -> None:
    judged(damaged(sound()))


def in_values(damaged: Tree) -> None:
    tree = damaged(json.loads(sound()))
    judged(json.dumps(tree).encode("utf-8", "surrogatepass"))


def in_one_part(part: str, damaged: Tree) -> None:
    document = json.loads(sound())
    document[part] = damaged([document[part]])
    document[part] = document[part][0] if len(document[part]) == 1 else document[part]
    judged(json.dumps(document).encode("utf-8", "surrogatepass"))


def in_a_file_of_the_cell(index: int, damaged: Bytes) -> None:
    """The file is damaged, its checksum that of the damaged content."""
    document = json.loads(sound())
    entry = document["cell"]["files"][index % len(document["cell"]["files"])]
    content = damaged(entry["content"].encode()).decode("utf-8", "replace")
    entry |= {"content": content, "sha256": hashlib.sha256(content.encode()).hexdigest()}
    judged(json.dumps(document).encode())


PARTS = st.sampled_from(["decision", "start", "figures", "provenance", "cell", "version", "format"])
TESTS: Checks = {
    "bytes": (in_bytes, (byte_damage(),)),
    "values": (in_values, (tree_damage(),)),
    "parts": (in_one_part, (PARTS, tree_damage())),
    "files of the cell": (in_a_file_of_the_cell, (st.integers(0, 9), byte_damage())),
}


@pytest.mark.parametrize("kind", TESTS)
def test_damage_is_told(kind: str) -> None:
    all_kept(TESTS, kind, FEW)


@pytest.mark.slow
@pytest.mark.parametrize("kind", TESTS)
def test_much_damage_is_told(kind: str) -> None:
    all_kept(TESTS, kind, MANY)
