"""Sphinx's settings: `sphinx-build -W -b html docs build/site`.

The pages of names come from the docstrings of what `hybrid_opt` exports, the command line from the
programs' `--help`, the gallery from the files of `studies/examples`, which are run;
`-D sphinx_gallery_conf.plot_gallery=0` leaves that out.
"""

from __future__ import annotations

import ast
import inspect
import io
import os
import re
import sys
from contextlib import redirect_stdout, suppress
from importlib import import_module
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
os.environ["TQDM_DISABLE"] = "1"  # an example's bar would be shown once per step

from sphinx_gallery.scrapers import figure_rst  # noqa: E402

import hybrid_opt as ho  # noqa: E402
from studies.__main__ import COMMAND, programs  # noqa: E402

project = "dual-arm-carry"
author = copyright = "the project's contributors"
release = version = ho.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.mathjax",
    "sphinx_copybutton",
    "sphinx_gallery.gen_gallery",
]
html_theme = "furo"
html_title = project
exclude_patterns = [
    "sg_execution_times.rst",
    *(f"gallery/*.{end}" for end in ("ipynb", "py", "md5", "zip")),
]
suppress_warnings = ["config.cache"]

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4

autodoc_typehints = "signature"
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True, "show-inheritance": True}
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_param = False  # one line may describe several parameters
napoleon_custom_sections = [("Attributes", "params_style")]
autodoc_type_aliases = {"Array": "Array"}


def examples() -> Path:
    """Write the examples for the gallery: with titles, beside a link to the cells' folder."""
    folder = ROOT / "build" / "examples"
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / "studies").exists():
        (folder / "studies").symlink_to(ROOT / "studies")
    (folder / "GALLERY_HEADER.rst").write_text(
        "Gallery\n=======\n\nEach example is a file of ``studies/examples`` and runs as it is.\n",
        "utf-8",
    )
    for path in sorted((ROOT / "studies" / "examples").glob("[0-9]*.py")):
        text = path.read_text("utf-8")
        words = ast.get_docstring(ast.parse(text)) or path.stem
        title, _, rest = words.partition(".\n")
        title = " ".join(title.rstrip(".").split())
        heading = f'"""\n{title}\n{"=" * len(title)}\n{rest}\n"""\n'
        end = ast.parse(text).body[0].end_lineno
        copy, new = folder / path.name, heading + "\n".join(text.splitlines()[end:]) + "\n"
        if not copy.exists() or copy.read_text("utf-8") != new:
            copy.write_text(new, "utf-8")
    return folder


def picture(_: Any, block: dict[str, Any], gallery: dict[str, Any]) -> str:
    """Return an example's last result that has a picture, as a notebook shows it."""
    for made in reversed(list(block["example_globals"].values())):
        if not inspect.isclass(made) and hasattr(made, "_repr_html_"):
            drawn = re.search("<svg.*</svg>", made._repr_html_(), flags=re.DOTALL)
            if drawn:
                path = Path(next(block["image_path_iterator"])).with_suffix(".svg")
                path.write_text(drawn[0], "utf-8")
                return str(figure_rst([path], gallery["src_dir"]))
    return ""


def purposes() -> dict[str, list[str]]:
    """Return the public names by purpose, as the page of the library groups them."""
    text = (ROOT / "docs" / "reference" / "library.md").read_text("utf-8")
    section = text.split("## The names by purpose")[1].split("\n## ")[0]
    rows = re.findall(r"^\| ([a-z ]+) \| (`.*`) \|$", section, flags=re.MULTILINE)
    return {group: re.findall(r"`(\w+)`", names) for group, names in rows}


def api() -> Path:
    """Write a page for every public name, with the examples that use it, and one for stored
    figures."""
    folder = ROOT / "docs" / "api"
    folder.mkdir(exist_ok=True)
    rows = {}
    for name in sorted(ho.__all__):
        thing = getattr(ho, name)
        summary = (inspect.getdoc(thing) or "").split("\n\n")[0].replace("\n", " ")
        kind = "autoclass" if inspect.isclass(thing) else "autofunction"
        target = f"hybrid_opt.{name}"
        used = [target]
        if inspect.isclass(thing):  # some are never called but by a method that makes one
            used += [f"{target}.{key}" for key in vars(thing) if not key.startswith("_")]
        page = "\n".join(
            [
                name,
                "=" * len(name),
                "",
                f".. {kind}:: {target}",
                "",
                f".. minigallery:: {' '.join(used)}",
                "   :add-heading: Examples",
                "",
            ]
        )
        _write(folder / f"{name}.rst", page)
        rows[name] = f"* :doc:`{name} <{name}>`: {summary}"
    stored = "Figures of a study: summary.json"
    page = f"{stored}\n{'=' * len(stored)}\n\n.. automodule:: studies.study.summary\n"
    _write(folder / "summary.rst", page)
    rows["summary"] = f"* :doc:`{stored} <summary>`"
    listed = "\n".join(f"   {name}" for name in (*sorted(ho.__all__), "summary"))
    title = "The library, name by name"
    index = [f"{title}\n{'=' * len(title)}\n", "What ``import hybrid_opt as ho`` gives.\n"]
    for group, names in {**purposes(), "stored figures": ["summary"]}.items():
        heading = group.capitalize()
        listed_here = "\n".join(rows[name] for name in names)
        index.append(f"{heading}\n{'-' * len(heading)}\n\n{listed_here}\n")
    index.append(f".. toctree::\n   :hidden:\n\n{listed}\n")
    _write(folder / "index.rst", "\n".join(index))
    current = {f"{name}.rst" for name in (*ho.__all__, "summary", "index")}
    for old in folder.glob("*.rst"):
        if old.name not in current:  # a page of an earlier build
            old.unlink()
    return folder


def command_line() -> Path:
    """Return a page with what `--help-all` prints of every program."""
    os.environ["COLUMNS"] = "86"
    title = "Command line"
    parts = [f"{title}\n{'=' * len(title)}\n", f"What ``{COMMAND} NAME --help-all`` prints.\n"]
    for name, (module, _) in programs().items():
        shown = io.StringIO()
        with redirect_stdout(shown), suppress(SystemExit):
            import_module(module).main(["--help-all"], f"{COMMAND} {name}")
        text = "\n".join(f"   {line}".rstrip() for line in shown.getvalue().splitlines())
        parts.append(f"{name}\n{'-' * len(name)}\n\n.. code-block:: text\n\n{text}\n")
    path = ROOT / "docs" / "reference" / "command-line.rst"
    _write(path, "\n".join(parts))
    return path


def _write(path: Path, text: str) -> None:
    """Write where something changed, so that Sphinx reads no page twice."""
    if not path.exists() or path.read_text("utf-8") != text:
        path.write_text(text, "utf-8")


api()
command_line()
sphinx_gallery_conf: dict[str, Any] = {
    "examples_dirs": [str(examples())],
    "gallery_dirs": ["gallery"],
    "filename_pattern": r"/\d\d_",
    "ignore_pattern": "studies",
    "within_subsection_order": "FileNameSortKey",
    "download_all_examples": False,
    "remove_config_comments": True,
    "backreferences_dir": "gallery/backreferences",
    "doc_module": ("hybrid_opt", "symbolic"),
    "image_scrapers": (picture,),
    "default_thumb_file": str(ROOT / "docs" / "images" / "cell-rack.png"),
    "show_memory": False,
    "write_computation_times": False,
    "abort_on_example_error": True,
}


def without_references(*given: Any) -> tuple[str | None, str | None]:
    """Return a signature and its result with type names unchanged: Sphinx inserts its references of
    aliases otherwise."""
    signature, returned = (
        text and re.sub(r"TypeAliasForwardRef\('(\w+)'\)", r"\1", text) for text in given[-2:]
    )
    return signature, returned


GENERATED = {
    "Tutorials": ["gallery/index"],
    "Reference": ["reference/command-line", "api/index"],
}
"""Pages that exist only on the site, by section of the index."""


def with_contents(_: Any, name: str, source: list[str]) -> None:
    """Give the first page the table of contents that its sections list."""
    if name != "index":
        return
    for section in source[0].split("\n## ")[1:]:
        caption = section.partition("\n")[0]
        pages = [*re.findall(r"\]\((.+?)\.md\)", section), *GENERATED.get(caption, [])]
        listed = "\n".join(pages)
        source[0] += f"\n```{{toctree}}\n:hidden:\n:caption: {caption}\n\n{listed}\n```\n"


def setup(app: Any) -> None:
    """Sphinx calls it."""
    app.connect("autodoc-process-signature", without_references)
    app.connect("source-read", with_contents)
