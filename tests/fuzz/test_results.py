"""Damaged results folders: read soundly or refused, by every program that reads them."""

from __future__ import annotations

import contextlib
import gzip
import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import strategies as st

from hybrid_opt.campaign.results import read_campaign
from studies.programs.comparison import compare
from studies.report.data import gather_carries
from tests.fuzz.damage import MANY, Bytes, Checks, Tree, all_kept, byte_damage, kept, tree_damage


@pytest.fixture(scope="module")
def damaged_copy(polished_study: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy whose files are damaged one at a time."""
    gather_carries(polished_study)  # what it needs is compiled before it has to be quick
    return Path(shutil.copytree(polished_study, tmp_path_factory.mktemp("damaged") / "results"))


@contextlib.contextmanager
def replaced(path: Path, content: bytes) -> Iterator[None]:
    """A file with other content, for a while."""
    before = path.read_bytes()
    path.write_bytes(content)
    try:
        yield
    finally:
        path.write_bytes(before)


def judged(root: Path, whole: Path) -> None:
    """What programs read is told as damaged, or sound, and then drawn without a fault."""
    compared = kept(lambda: compare(whole, root), str(root), "compare", "share", "in common")
    if compared is None:
        return
    results = read_campaign(root)
    for front in results.fronts:
        assert np.isfinite(front.objectives).all()
        if front.polished is not None:
            assert front.x.shape[1] == results.workcell.task.n_var
            assert np.abs(front.x).max(initial=0.0) < 100.0
    kept(lambda: gather_carries(root), str(root))


def read_files(root: Path) -> list[str]:
    """The files of a folder that programs read, by name."""
    return sorted(
        path.relative_to(root).as_posix()
        for path in root.rglob("*")
        if path.is_file()
        and not path.name.startswith(".")
        and path.suffix in (".json", ".gz", ".csv", ".toml", ".urdf")
    )


def in_bytes(root: Path, whole: Path, share: float, damaged: Bytes) -> None:
    names = read_files(root)
    path = root / names[int(share * len(names))]
    with replaced(path, damaged(path.read_bytes())):
        judged(root, whole)


def in_values(root: Path, whole: Path, share: float, damaged: Tree) -> None:
    names = [name for name in read_files(root) if name.endswith(".json")]
    path = root / names[int(share * len(names))]
    tree = damaged(json.loads(path.read_bytes()))
    with replaced(path, json.dumps(tree).encode("utf-8", "surrogatepass")):
        judged(root, whole)


def in_evaluations(root: Path, whole: Path, damaged: Bytes) -> None:
    """Candidates are damaged before they are packed, so that the checksum is right."""
    path, *_ = sorted((root / "replicas").rglob("*.csv.gz"))
    table = gzip.compress(damaged(gzip.decompress(path.read_bytes())), mtime=0)
    with replaced(path, table):
        judged(root, whole)


SHARE = st.floats(0.0, 1.0, exclude_max=True)
TESTS: Checks = {
    "bytes": (in_bytes, (SHARE, byte_damage())),
    "values": (in_values, (SHARE, tree_damage())),
    "evaluations": (in_evaluations, (byte_damage(),)),
}


@pytest.mark.parametrize("examples", [15, pytest.param(MANY, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", TESTS)
def test_damage_is_told(kind: str, examples: int, damaged_copy: Path, polished_study: Path) -> None:
    all_kept(TESTS, kind, examples, damaged_copy, polished_study)
