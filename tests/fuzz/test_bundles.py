"""Damaged bundles: told, and whatever is not as it was written stays where it is."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import strategies as st

from hybrid_opt.bundles.bundle import MANIFEST, read_manifest, write_bundle
from hybrid_opt.store.files import sha256
from tests.fuzz.damage import Bytes, Tree, byte_damage, tree_damage
from tests.fuzz.promises import MANY, Checks, all_kept, kept

FILES: dict[str, str | bytes] = {"job.csv": "time\n0.0\n", "goals/1_press.yaml": b"a: 1\n"}
ABOUT: dict[str, Any] = {
    "target": "csv",
    "name": "rack-00000000",
    "duration": 7.25,
    "phases": [{"name": "press", "peak_normal_force": [61.5, 60.25], "limits": {"torque": 0.75}}],
    "trajectory": {"file": "", "replica": None},
    "warnings": ["nothing holds the box"],
}

FEW = 25


def judged(name: str, damaged: Callable[[bytes], bytes]) -> None:
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


def in_bytes(which: float, damaged: Bytes) -> None:
    names = [MANIFEST, *FILES]
    judged(names[int(which * len(names))], damaged)


def in_values(damaged: Tree) -> None:
    judged(MANIFEST, lambda content: encoded(damaged(json.loads(content))))


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
    "bytes": (in_bytes, (SHARE, byte_damage())),
    "values": (in_values, (tree_damage(),)),
    "signed values": (with_right_checksum, (tree_damage(),)),
}


@pytest.mark.parametrize("kind", TESTS)
def test_damage_is_told(kind: str) -> None:
    all_kept(TESTS, kind, FEW)


@pytest.mark.slow
@pytest.mark.parametrize("kind", TESTS)
def test_much_damage_is_told(kind: str) -> None:
    all_kept(TESTS, kind, MANY)
