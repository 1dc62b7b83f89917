"""Links, files, programs and options that the documentation names exist; addresses are whole."""

from __future__ import annotations

import ast
import re
import shlex
import subprocess
import sys
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from tests.waiting import HANGS

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")])
NAMES = [str(path.relative_to(ROOT)) for path in DOCUMENTS]

LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
COMMAND = re.compile(r"python -m ([a-z_]+(?:\.[a-z_]+)*)([^\n`#]*)")
OPTION = re.compile(r"--[a-z][a-z-]*")
SOURCE = re.compile(r"`((?:symbolic|codegen|hybrid_opt|studies|tests|docs)/[\w./-]+)`")
OWN = ("symbolic", "codegen", "hybrid_opt", "studies")


def anchors(text: str) -> set[str]:
    """Anchors of a document's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.+)$", text, flags=re.MULTILINE)
    return {
        re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings
    }


def is_address(target: str) -> bool:
    """Whether a link to another site can be asked for; that it answers is for CI's site job."""
    found = urlsplit(target)
    host = found.hostname or ""
    return found.scheme == "https" and "." in host and not target.endswith((".", ",", ";"))


def broken_links(path: Path, text: str) -> list[str]:
    """Links of a document to files or headings that do not exist."""
    broken = []
    for target in LINK.findall(text):
        if "://" in target or target.startswith("mailto:"):
            if not is_address(target):
                broken.append(target)
            continue
        file, _, anchor = target.partition("#")
        other = (path.parent / file).resolve() if file else path
        known = other.exists() and (not anchor or anchor in anchors(other.read_text("utf-8")))
        if not known:
            broken.append(target)
    return broken


def commands(text: str) -> list[tuple[str, list[str]]]:
    """Modules of this project that a document runs, with the options it gives them."""
    return [
        (module, OPTION.findall(rest))
        for module, rest in COMMAND.findall(text)
        if module.split(".")[0] in OWN
    ]


@cache
def help_of(module: str) -> str:
    finished = subprocess.run(
        [sys.executable, "-m", module, "--help"],
        capture_output=True,
        text=True,
        timeout=HANGS,
        cwd=ROOT,
        check=False,
    )
    assert finished.returncode == 0, finished.stderr
    return finished.stdout


@pytest.mark.parametrize("name", NAMES)
def test_links_lead_somewhere(name: str) -> None:
    path = ROOT / name
    assert broken_links(path, path.read_text("utf-8")) == []


@pytest.mark.parametrize("name", NAMES)
def test_commands_exist_with_their_options(name: str) -> None:
    for module, options in commands((ROOT / name).read_text("utf-8")):
        assert find_spec(module) is not None, module
        known = set(OPTION.findall(help_of(module)))
        assert set(options) <= known | {"--help"}, (module, options)


@pytest.mark.parametrize("name", NAMES)
def test_named_sources_exist(name: str) -> None:
    for source in SOURCE.findall((ROOT / name).read_text("utf-8")):
        assert (ROOT / source).exists(), source


def test_what_is_broken_would_be_found(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    links = "[x](gone.md) [y](#a-heading) [z](#another) [a](https://toml.io) [b](http://x) [c](https://x)"
    page.write_text(f"# A heading\n\n{links}\n")
    found = broken_links(page, page.read_text())
    assert found == ["gone.md", "#another", "http://x", "https://x"]
    assert commands("`python -m studies.rack --jobs 2`") == [("studies.rack", ["--jobs"])]
    assert "--no-such-option" not in OPTION.findall(help_of("studies.rack"))


@pytest.mark.slow
def test_the_lines_for_a_cell_of_ones_own_end_without_a_warning(tmp_path: Path) -> None:
    """As README has them, but for the installation; in a folder that has the checkout's studies."""
    section = (ROOT / "README.md").read_text("utf-8").split("## Your own cell")[1]
    install, *lines = re.findall(r"```sh\n(.*?)```", section, flags=re.DOTALL)[0].splitlines()
    assert install.startswith("pip install")
    assert len(lines) == 3
    (tmp_path / "studies").symlink_to(ROOT / "studies")
    for line in lines:
        words = shlex.split(line)
        words[0] = sys.executable if words[0] == "python" else words[0]
        done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        assert "WARNING" not in done.stdout + done.stderr, done.stdout
    assert done.stdout.startswith("Run this carry: ")
    assert "grip at rest, with the usual uncertainty: 96.4 N of 120.0 N" in done.stderr


def test_the_index_lists_every_page() -> None:
    docs = ROOT / "docs"
    pages = {path.relative_to(docs).as_posix() for path in docs.glob("**/*.md")} - {
        "README.md",
        "index.md",
    }
    assert pages <= set(LINK.findall((docs / "README.md").read_text("utf-8")))


@pytest.mark.parametrize("name", [name for name in NAMES if name.startswith("docs/measured/")])
def test_a_measurement_has_its_date_and_its_command(name: str) -> None:
    text = (ROOT / name).read_text("utf-8")
    assert re.search(r"\n\n20\d\d-\d\d-\d\d[ .]", text)
    assert re.search(r"^    python ", text, flags=re.MULTILINE)
    assert re.search(r"^\|", text, flags=re.MULTILINE)


QUESTION = re.compile(r"^\| (.*\*\*(.+?)\*\*.*\?) \| `([^`]+)` \|$", flags=re.MULTILINE)


def test_questions_are_answered_by_one_file_each() -> None:
    """The file exists and speaks of what the question is about."""
    asked = QUESTION.findall((ROOT / "CONTRIBUTING.md").read_text("utf-8"))
    assert len({file for _, _, file in asked}) == len(asked) >= 20
    for question, subject, file in asked:
        assert subject.lower() in (ROOT / file).read_text("utf-8").lower(), question


def test_every_room_is_listed_and_says_what_is_inside() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text("utf-8")
    rooms = [
        path.parent
        for package in ("symbolic", "hybrid_opt")
        for path in (ROOT / package).glob("*/__init__.py")
    ]
    for room in rooms:
        assert f"| `{room.relative_to(ROOT).as_posix()}` |" in text, room
        assert ast.get_docstring(ast.parse((room / "__init__.py").read_text("utf-8"))), room
