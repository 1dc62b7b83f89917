"""The examples run, their copies too; the page of the library and the README hold the first."""

from __future__ import annotations

import ast
import json
import re
from pathlib import Path

import pytest

import hybrid_opt as ho
from studies.examples.__main__ import main as copy
from studies.program import BAD_INPUT
from symbolic.read.cell import load
from tests.refusals import ended_by

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = sorted((ROOT / "studies" / "examples").glob("[0-9]*.py"))
NAMES = [path.name for path in EXAMPLES]
NOTEBOOK = ROOT / "studies" / "examples" / "tour.ipynb"

SMALL = {
    "evaluations=1000": "evaluations=120",
    "evaluations=300": "evaluations=60",
    "range(5)": "range(2)",
    "cell.random(500": "cell.random(60",
    "attempts=60": "attempts=1, rounds=1",
    "evaluations=2000": "evaluations=400",
    "curve_points=5": "curve_points=2",
    "polish(front, rng=rng)\nfound": "polish(front, rng=rng, settings=FEW)\nfound",
}
"""What makes the examples small enough for a test."""

FEW = ho.PolishSettings(attempts=2)
"""Settings of the first example's polish in a test."""

LONG = ("propose", "sweep", "sensitivities", "grips")
"""Examples of what has short tests of its own."""

TEN_LINES = 12
"""Lines that the way from a file to a robot's trajectory may take, imports included."""


def code_of(path: Path) -> str:
    """An example without its docstring."""
    text = path.read_text("utf-8")
    first = ast.parse(text).body[0]
    assert first.end_lineno is not None
    return "\n".join(text.splitlines()[first.end_lineno :]).strip()


def blocks(page: str) -> list[str]:
    """The Python code of a page."""
    return [block.strip() for block in re.findall(r"```python\n(.*?)```", page, flags=re.DOTALL)]


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, marks=pytest.mark.slow if path.stem[3:] in LONG else ())
        for path in EXAMPLES
    ],
    ids=NAMES,
)
def test_it_runs(
    path: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    code = path.read_text("utf-8")
    for full, small in SMALL.items():
        code = code.replace(full, small)
    run(code, tmp_path, monkeypatch)
    assert capsys.readouterr().out or list((tmp_path / "out").iterdir())


@pytest.mark.slow
def test_the_notebook_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    cells = json.loads(NOTEBOOK.read_text("utf-8"))["cells"]
    code = [cell["source"] for cell in cells if cell["cell_type"] == "code"]
    assert len(code) >= 8
    assert all(cell["outputs"] == [] for cell in cells if cell["cell_type"] == "code")
    run("\n".join(code), tmp_path, monkeypatch)
    assert "Recommended" in capsys.readouterr().out
    assert list((tmp_path / "out").rglob("manifest.json"))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 21))
def test_the_first_runs_with_every_seed(
    seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As the README prints it."""
    code = EXAMPLES[0].read_text("utf-8")
    assert "default_rng(1)" in code
    run(code.replace("default_rng(1)", f"default_rng({seed})"), tmp_path, monkeypatch)
    assert "Recommended" in capsys.readouterr().out
    assert list((tmp_path / "out").iterdir())


def run(code: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As a user does in the repository, but for what it writes."""
    (folder / "studies").symlink_to(ROOT / "studies")
    monkeypatch.chdir(folder)
    exec(compile(code, "example", "exec"), {"__name__": "__main__", "FEW": FEW})


def test_a_copy_holds_what_the_examples_and_its_cells_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert copy([str(tmp_path / "new")]) == 0
    monkeypatch.chdir(tmp_path / "new")
    assert Path("studies/examples/tour.ipynb").read_bytes() == NOTEBOOK.read_bytes()
    copies = sorted(Path("studies/examples").glob("*.py"))
    assert [path.name for path in copies] == NAMES
    read = {name for path in copies for name in re.findall(r'"(studies/[^"]+)"', path.read_text())}
    assert read == {"studies/workcells/rack.toml", "studies/problems/past-a-post.toml"}
    assert all(Path(name).is_file() for name in read)
    cells = sorted(Path("studies/workcells").iterdir())
    assert [load(path).digest for path in cells] == [load(ROOT / path).digest for path in cells]
    with ended_by("folder-in-use"):
        assert copy([]) == BAD_INPUT


@pytest.mark.parametrize("page", ["README.md", "docs/reference/library.md"])
def test_pages_show_the_first(page: str) -> None:
    assert code_of(EXAMPLES[0]) in blocks((ROOT / page).read_text("utf-8"))


def test_every_public_name_is_used_in_an_example() -> None:
    used = set(re.findall(r"\bho\.(\w+)", "".join(code_of(path) for path in EXAMPLES)))
    assert set(ho.__all__) <= used


def test_examples_are_numbered_short_and_explained() -> None:
    assert [int(name[:2]) for name in NAMES] == list(range(len(NAMES)))
    for path in EXAMPLES:
        words = ast.get_docstring(ast.parse(path.read_text("utf-8"))) or ""
        title, _, text = words.partition("\n\n")
        assert title.endswith("."), path
        assert text, path
        assert len(code_of(path).splitlines()) <= 20
    first = [line for line in code_of(EXAMPLES[0]).splitlines() if line.strip()]
    assert len(first) <= TEN_LINES
    imports = [line for line in first if "import" in line]
    assert imports == ["import numpy as np", "import hybrid_opt as ho"]
