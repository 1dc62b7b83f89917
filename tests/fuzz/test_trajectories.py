"""Damaged trajectory files and bundles: read soundly or refused, nothing of anybody's is lost."""

from __future__ import annotations

import hashlib
import json
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import strategies as st

from hybrid_opt.store.bundle_file import MANIFEST, read_manifest, write_bundle
from hybrid_opt.store.files import sha256
from hybrid_opt.store.trajectory_file import read_trajectory, write_trajectory
from tests.fuzz.damage import MANY, Bytes, Checks, Tree, all_kept, byte_damage, kept, tree_damage
from tests.symbolic.cells import rack_cell

FEW = 30


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


def in_a_file_of_the_cell(index: int, damaged: Bytes) -> None:
    """The file is damaged, its checksum that of the damaged content."""
    document = json.loads(sound())
    entry = document["cell"]["files"][index % len(document["cell"]["files"])]
    content = damaged(entry["content"].encode()).decode("utf-8", "replace")
    entry |= {"content": content, "sha256": hashlib.sha256(content.encode()).hexdigest()}
    judged(json.dumps(document).encode())


FILES: dict[str, str | bytes] = {"job.csv": "time\n0.0\n", "goals/1_press.yaml": b"a: 1\n"}
ABOUT: dict[str, Any] = {
    "target": "data",
    "name": "rack-00000000",
    "duration": 7.25,
    "phases": [{"name": "press", "peak_normal_force": [61.5, 60.25], "limits": {"torque": 0.75}}],
    "trajectory": {"file": "", "replica": None},
    "warnings": ["nothing holds the box"],
}


def bundle_judged(name: str, damaged: Callable[[bytes], bytes]) -> None:
    """One file of a bundle is damaged, and then the bundle is written anew."""
    with tempfile.TemporaryDirectory() as parent:
        folder = Path(parent) / "bundle"
        write_bundle(folder, FILES, ABOUT)
        path = folder / name
        sound = path.read_bytes()
        content = damaged(sound)
        path.write_bytes(content)
        found = kept(lambda: read_manifest(folder), str(folder))
        if found is not None:
            assert set(found["files"]) == set(FILES)
            assert {key: found[key] for key in ABOUT} == ABOUT
        again = kept(lambda: write_bundle(folder, {"other.csv": "new"}, ABOUT), str(folder))
        if again is None:
            assert path.read_bytes() == content
        else:
            assert json_value(content) == json_value(sound)
            assert {entry.name for entry in folder.iterdir()} == {MANIFEST, "other.csv"}
        assert [entry.name for entry in folder.parent.iterdir()] == [folder.name]


def json_value(content: bytes) -> Any:
    """What a file says, whatever the blanks in it; its bytes where it is no JSON."""
    try:
        return json.loads(content)
    except ValueError:
        return content


def of_a_bundle_in_bytes(which: float, damaged: Bytes) -> None:
    names = [MANIFEST, *FILES]
    bundle_judged(names[int(which * len(names))], damaged)


def of_a_bundle_in_values(damaged: Tree) -> None:
    bundle_judged(MANIFEST, lambda content: encoded(damaged(json.loads(content))))


def with_right_checksum(damaged: Tree) -> None:
    """What is damaged and signed again is no manifest, or is one that can be relied on."""
    with tempfile.TemporaryDirectory() as parent:
        folder = Path(parent) / "bundle"
        write_bundle(folder, FILES, ABOUT)
        tree = json.loads((folder / MANIFEST).read_bytes())
        tree.pop("sha256")
        tree = damaged(tree)
        if isinstance(tree, dict):
            tree["sha256"] = sha256(encoded(tree))
        (folder / MANIFEST).write_bytes(encoded(tree))
        before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
        found = kept(lambda: read_manifest(folder), str(folder))
        if found is not None:
            assert all(isinstance(value, str) for value in found["files"].values())
        if kept(lambda: write_bundle(folder, {"other.csv": "new"}, ABOUT), str(folder)) is None:
            assert {path: path.read_bytes() for path in before} == before


def encoded(tree: Any) -> bytes:
    return (json.dumps(tree, indent=1) + "\n").encode()


SHARE = st.floats(0.0, 1.0, exclude_max=True)
TESTS: Checks = {
    "bytes": (in_bytes, (byte_damage(),)),
    "values": (in_values, (tree_damage(),)),
    "files of the cell": (in_a_file_of_the_cell, (st.integers(0, 9), byte_damage())),
    "bundle, bytes": (of_a_bundle_in_bytes, (SHARE, byte_damage())),
    "bundle, values": (of_a_bundle_in_values, (tree_damage(),)),
    "bundle, signed values": (with_right_checksum, (tree_damage(),)),
}


@pytest.mark.parametrize("examples", [FEW, pytest.param(MANY, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", TESTS)
def test_damage_is_told(kind: str, examples: int) -> None:
    all_kept(TESTS, kind, examples)
