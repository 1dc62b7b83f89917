"""Files, folders and extras of a command line are checked before anything heavy is imported."""

from __future__ import annotations

import subprocess
import sys
from contextlib import suppress
from importlib import import_module
from pathlib import Path

import pytest

from studies.__main__ import main, programs
from studies.options import EXTRAS, PathType, require_extra
from symbolic.errors import SettingsError
from tests.refusals import ended_by, refused
from tests.symbolic.cells import RACK, ROOT
from tests.waiting import HANGS

PROBLEM = ROOT / "studies" / "problems" / "past-a-post.toml"


@pytest.fixture
def places(tmp_path: Path) -> dict[str, str]:
    """Paths by name, for command lines."""
    (tmp_path / "folder").mkdir()
    (tmp_path / "locked").mkdir()
    (tmp_path / "study").mkdir()
    (tmp_path / "study" / "configuration.json").write_text("{}")
    (tmp_path / "study" / "recommended.json").write_text("{}")
    (tmp_path / "carry.json").write_text('{"format": "dual-arm-carry trajectory", "version": 1}')
    (tmp_path / "broken.toml").write_text("[task\n")
    names = ("folder", "study", "carry.json", "broken.toml", "cary.json", "new", "new/x.gif")
    found = {name: str(tmp_path / name) for name in names}
    return found | {
        "cell": str(RACK),
        "problem": str(PROBLEM),
        "locked": str(tmp_path / "locked" / "new"),
    }


CASES = (
    ("inspect", "cary.json", "carry.json"),
    ("inspect", "carry.json", "workcell file"),
    ("inspect", "folder", "regular file"),
    ("inspect", "broken.toml", "broken.toml: "),
    ("inspect", "cell --output carry.json", "folder"),
    ("run", "cell --output locked", "read-only"),
    ("run", "cell --animation new", ".gif or .mp4"),
    ("replay", "cell", "trajectory file"),
    ("replay", "cary.json", "carry.json"),
    ("robust", "study", "study/recommended.json"),
    ("export", "problem --target json", "trajectory file"),
    ("export", "carry.json --target json --output locked", "read-only"),
    ("simulate", "carry.json --film locked", ".gif or .mp4"),
    ("simulate", "carry.json --mjcf folder", "folder"),
    ("propose", "problem --output problem", "problem file"),
    ("propose", "problem --output locked", "read-only"),
    ("recommend", "new", "results folder"),
    ("recommend", "carry.json", "results folder"),
    ("recommend", "folder", "configuration.json"),
    ("recommend", "study --output new --duration 0", "--duration: found '0'"),
    ("compare", "study new", "new: "),
    ("calibrate", "cell new", "new: "),
    ("check", "cell new", "new: "),
    ("scene", "new", "new: "),
    ("sweep", "cell --over payload.mass=1 --path cell", "trajectory file"),
    ("regenerate", "new", "new: "),
)


def test_a_wrong_place_is_refused_before_anything_heavy_is_imported(
    places: dict[str, str],
) -> None:
    """All in one process, which ends with none of the heavy libraries imported."""
    lines = [[name, *(places.get(word, word) for word in line.split())] for name, line, _ in CASES]
    # No folder is read-only for root, as whom containers test.
    text = (
        "import os, sys\n"
        "may = os.access\n"
        "os.access = lambda path, mode: 'locked' not in str(path) and may(path, mode)\n"
        "from studies.__main__ import main\n"
        f"for line in {lines!r}:\n"
        "    try:\n"
        "        code = main(line)\n"
        "    except SystemExit as end:\n"
        "        code = end.code\n"
        "    assert code == 2, line\n"
        "    print('END', file=sys.stderr)\n"
        "print(*sys.modules)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", text], cwd=ROOT, capture_output=True, text=True, timeout=HANGS
    )
    assert done.returncode == 0, done.stderr
    told = done.stderr.split("END\n")
    for (name, line, words), said in zip(CASES, told, strict=False):
        assert words in said, (name, line, said)
        assert said.startswith(f"python -m studies {name}: "), said
    heavy = {"casadi", "coal", "matplotlib", "mujoco", "pinocchio", "pymoo", "scipy", "viser"}
    assert heavy.isdisjoint(done.stdout.split())


@pytest.mark.parametrize(
    ("line", "module"),
    [
        ("live cell", "viser"),
        ("propose problem", "cma"),
        ("simulate carry.json", "mujoco"),
        ("run cell --simulate", "mujoco"),
        ("run cell --executor dask", "distributed"),
        ("run cell --animation new/x.mp4", "imageio_ffmpeg"),
        ("research.thresholds", "mujoco"),
    ],
)
def test_a_missing_extra_is_named_before_any_work(
    line: str,
    module: str,
    places: dict[str, str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.chdir(tmp_path)
    places["new/x.mp4"] = str(tmp_path / "x.mp4")
    words = [places.get(word, word) for word in line.split()]
    before = sorted(tmp_path.rglob("*"))
    (extra,) = (name for name, needed in EXTRAS.items() if module in needed)
    with ended_by("missing-extra", module, f"pip install 'dual-arm-carry[{extra}]'"):
        assert main(words) == 2
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("extra", EXTRAS)
def test_modules_of_an_extra_are_installed_with_the_tests(extra: str) -> None:
    require_extra(extra, "a test")
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, EXTRAS[extra][0], None)
        with refused(SettingsError, "missing-extra", EXTRAS[extra][0]):
            require_extra(extra, "a test")


@pytest.mark.parametrize("name", programs())
def test_every_path_of_a_program_says_what_it_has_to_be(name: str) -> None:
    """None of them is a bare path, or a text that becomes one."""
    parser = import_module(programs()[name][0]).main.parser()
    places = {"DIR", "FILE", "FOLDER", "RESULTS", "WORKCELL", "PROBLEM"}
    places |= {"RUN", "SCENE", "TRAJECTORY", "RUN_A", "RUN_B"}
    for action in parser._actions:
        assert action.type is not Path, action.dest
        if action.metavar in places:
            assert isinstance(action.type, PathType), action.dest


def asked(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    with suppress(SystemExit):
        assert main(words) == 0
    said = capsys.readouterr()
    assert said.err == ""
    return said.out


def test_help_and_version_are_words_that_people_try(capsys: pytest.CaptureFixture[str]) -> None:
    assert asked(["help"], capsys) == asked(["--help"], capsys) == asked([], capsys)
    assert asked(["help", "replay"], capsys) == asked(["replay", "--help"], capsys)
    version = asked(["--version"], capsys)
    assert version.startswith("dual-arm-carry ")
    assert version == asked(["replay", "--version"], capsys)
    assert main(["help", "rnu"]) == 2
