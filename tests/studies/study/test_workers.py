"""Workers are on their way before what a study needs is imported, where it needs any here."""

from __future__ import annotations

from pathlib import Path

import pytest

from studies import run


@pytest.mark.parametrize(
    ("arguments", "started"),
    [
        (["--quick"], True),
        (["--executor", "processes"], True),
        (["--executor", "dask", "--scheduler", "tcp://here:8786"], False),
        (["--executor=dask"], False),
    ],
)
def test_workers_are_started_for_work_on_this_machine(
    arguments: list[str], started: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    loaded: list[tuple[str, ...]] = []
    monkeypatch.setattr(run, "warm_up", lambda *modules: loaded.append(modules))
    assert run.main([str(tmp_path / "none.toml"), *arguments]) == 2
    assert loaded == ([run.WORKERS_LOAD] if started else [])


@pytest.mark.parametrize("arguments", [["--help"], ["cell.toml", "-h"], ["cell.toml", "--qick"]])
def test_none_are_started_without_work(
    arguments: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def start(*modules: str) -> None:
        raise AssertionError(modules)

    monkeypatch.setattr(run, "warm_up", start)
    with pytest.raises(SystemExit):
        run.main(arguments)
    assert capsys.readouterr()
