"""Links, files, programs and options that the documentation names exist; addresses are whole.

Python blocks are parts of examples, which tests run; TOML blocks can be read; the shell lines of
the own-cell tutorial are run. Programs and options of all other shell lines are checked."""

from __future__ import annotations

import ast
import re
import shlex
import subprocess
import sys
import textwrap
import tomllib
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import urlsplit

import pytest

import hybrid_opt as ho
from tests.waiting import HANGS

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")])
NAMES = [str(path.relative_to(ROOT)) for path in DOCUMENTS]

LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
COMMAND = re.compile(r"(python -m |(?<!\")dual-arm-carry )([a-z_]+(?:\.[a-z_]+)*)([^\n`#]*)")
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
    found = [
        (name if how.startswith("python") else f"studies.{name}", OPTION.findall(rest))
        for how, name, rest in COMMAND.findall(text)
    ]
    return [(module, options) for module, options in found if module.split(".")[0] in OWN]


@cache
def help_of(module: str) -> str:
    finished = subprocess.run(
        [sys.executable, "-m", module, "--help-all" if module.startswith("studies.") else "--help"],
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
    assert commands("dual-arm-carry run x --quick") == [("studies.run", ["--quick"])]
    assert "--no-such-option" not in OPTION.findall(help_of("studies.rack"))


def blocks(text: str, language: str) -> list[str]:
    """Fenced code blocks of a document, without the indentation of list items."""
    found = re.findall(rf"^ *```{language}\n(.*?)^ *```", text, flags=re.DOTALL | re.MULTILINE)
    return [textwrap.dedent(block) for block in found]


def test_python_blocks_are_parts_of_examples() -> None:
    """`tests/studies/test_examples.py` runs these."""
    examples = "".join(path.read_text("utf-8") for path in ROOT.glob("studies/examples/*.py"))
    found = [block for path in DOCUMENTS for block in blocks(path.read_text("utf-8"), "python")]
    assert found
    for block in found:
        assert block.strip() in examples, block


def test_toml_blocks_can_be_read() -> None:
    found = [block for path in DOCUMENTS for block in blocks(path.read_text("utf-8"), "toml")]
    assert len(found) > 5
    for block in found:
        assert tomllib.loads(block), block


@pytest.mark.slow
def test_the_tutorial_of_a_cell_of_ones_own_ends_with_a_bundle(tmp_path: Path) -> None:
    """As printed, but for the installation; in a folder that has the checkout's studies."""
    lines = blocks((ROOT / "docs/tutorials/two-robots.md").read_text("utf-8"), "sh")[0].splitlines()
    readme = (ROOT / "README.md").read_text("utf-8").split("## Your own cell")[1]
    assert blocks(readme, "sh")[0].splitlines() == lines[1:-1]
    assert lines[1].startswith("pip install")
    (tmp_path / "studies").symlink_to(ROOT / "studies")
    printed = ""
    for line in lines[2:]:
        words = shlex.split(line)
        if words[0] == "dual-arm-carry":
            words[:1] = [sys.executable, "-m", "studies"]
        done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        assert "WARNING" not in done.stdout + done.stderr, done.stdout
        printed += done.stdout + done.stderr
    assert "Run this carry: " in printed
    assert " 96.4 N of 120.0 N" in printed
    assert list(tmp_path.glob("bundles/*/torque/manifest.json"))


def test_the_index_lists_every_page() -> None:
    docs, text = ROOT / "docs", (ROOT / "docs/index.md").read_text("utf-8")
    pages = {path.relative_to(docs).as_posix() for path in docs.glob("**/*.md")} - {"index.md"}
    assert pages == {link for link in LINK.findall(text) if "://" not in link}


def test_the_library_page_groups_every_public_name_once() -> None:
    text = (ROOT / "docs/reference/library.md").read_text("utf-8")
    section = text.split("## The names by purpose")[1].split("\n## ")[0]
    assert sorted(re.findall(r"`(\w+)`", section)) == sorted(ho.__all__)


MOST_WORDS = 20_000
"""Largest number of words of all pages together, as `wc -w` counts."""


def test_pages_stay_short() -> None:
    pages = [path.read_text("utf-8") for path in ROOT.glob("docs/**/*.md")]
    assert sum(len(page.split()) for page in pages) <= MOST_WORDS


def test_every_benchmark_has_a_command() -> None:
    text = (ROOT / "docs/reference/benchmarks.md").read_text("utf-8")
    rows = re.findall(r"^\|(?! ?-)(.*)\|(.*)\|(.*)\|$", text, flags=re.MULTILINE)[1:]
    assert len(rows) >= 5
    for *_, command in rows:
        assert re.fullmatch(r" `(dual-arm-carry|python) .*` ", command), command


def test_pages_that_the_packages_name_exist() -> None:
    named = {
        (path.name, page)
        for package in OWN
        for ending in ("py", "toml", "c", "cpp", "hpp", "js")
        for path in (ROOT / package).rglob(f"*.{ending}")
        for page in re.findall(r"\bdocs/[\w./-]+\.md(?! there)", path.read_text("utf-8"))
    }
    assert len(named) > 20
    assert [each for each in sorted(named) if not (ROOT / each[1]).is_file()] == []


def test_every_room_says_what_is_inside() -> None:
    for package in ("symbolic", "hybrid_opt"):
        for path in (ROOT / package).glob("*/__init__.py"):
            assert ast.get_docstring(ast.parse(path.read_text("utf-8"))), path
