"""The page from a cell to a bundle runs as it stands."""

from __future__ import annotations

from pathlib import Path

import pytest

from hybrid_opt.bundles.bundle import read_manifest
from tests.studies.test_examples import ROOT, SMALL, blocks


def test_the_page_runs_from_its_first_block_to_the_last(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "studies").symlink_to(ROOT / "studies")
    monkeypatch.chdir(tmp_path)
    space: dict[str, object] = {"__name__": "__main__"}
    code = blocks((ROOT / "docs" / "cell-to-bundle.md").read_text("utf-8"))
    assert len(code) == 5
    for block in code:
        for full, small in SMALL.items():
            block = block.replace(full, small)
        exec(compile(block, "docs/cell-to-bundle.md", "exec"), space)
    out = capsys.readouterr().out
    assert "approach" in out
    (folder,) = (tmp_path / "bundles").iterdir()
    assert folder.name.startswith("rack-nsga2-r00-p0001-")
    assert {target.name for target in folder.iterdir()} == {"ros2-control", "json", "csv"}
    for target in folder.iterdir():
        assert read_manifest(target)["target"] == target.name
