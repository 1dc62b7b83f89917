"""Hostile files given to the real programs: one message, exit code 2, soon, in little memory."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from threading import Timer

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from symbolic.safe_io import MEBIBYTE
from tests.fuzz.damage import Bytes, byte_damage, xml_damage
from tests.symbolic.cells import ROOT
from tests.symbolic.read.samples import GOFA, RACK, sample_data, write
from tests.symbolic.read.test_urdf_file import chain
from tests.waiting import soon

SLOW = pytest.mark.slow
PATIENCE = 300.0
"""A program that hangs is ended after so long [s]."""


def ended(program: str, *arguments: str) -> tuple[int, str, int]:
    """Exit code, messages and peak memory [bytes] of a program."""
    with tempfile.TemporaryFile() as said, soon():
        process = subprocess.Popen(
            [sys.executable, "-m", f"studies.{program}", *arguments],
            cwd=ROOT,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=said,
        )
        end = Timer(PATIENCE, process.kill)
        end.start()
        _, status, usage = os.wait4(process.pid, 0)
        end.cancel()
        process.returncode = os.waitstatus_to_exitcode(status)
        said.seek(0)
        return process.returncode, said.read().decode(), usage.ru_maxrss * 1024


@cache
def idle() -> int:
    """Memory of a program that is given nothing [bytes]; all begin alike."""
    return ended("inspect", "nowhere")[2]


def refused(size: int, program: str, *arguments: str) -> str:
    """The message with which a program refuses files of this size [bytes] together."""
    code, said, memory = ended(program, *arguments)
    assert code == 2, said
    assert "Traceback" not in said, said
    assert said.strip()
    assert memory - idle() < 10 * size + 300 * MEBIBYTE
    return said


def triangles(path: Path, count: int) -> None:
    """A mesh of so many, each on its own."""
    kind = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
    content = np.zeros(count, kind)
    content["corners"] = np.random.default_rng(1).uniform(-0.5, 0.5, (count, 3, 3))
    path.write_bytes(b"\0" * 80 + np.uint32(count).tobytes() + content.tobytes())


SHAPES = "<collision><geometry><sphere radius='0.1'/></geometry></collision>" * 3000 + "</link>"
CASES: dict[str, tuple[str, Callable[[Path], object], str]] = {
    "a device": ("cell.toml", lambda path: path.symlink_to("/dev/zero"), "device"),
    "tables": ("cell.toml", lambda path: path.write_bytes(b"[[a]]\n" * 170_000), "a: "),
    "a chain": ("a.urdf", lambda path: path.write_text(chain(50_000)), " 100000 "),
    "shapes": (
        "a.urdf",
        lambda path: path.write_text(GOFA.read_text().replace("</link>", SHAPES, 1)),
        "raise collision.most_pieces",
    ),
    "triangles": ("m.stl", lambda path: triangles(path, 190_000), "enormous mesh"),
    "few triangles": ("m.stl", lambda path: triangles(path, 3000), "enormous mesh"),
    "many triangles": ("m.stl", lambda path: triangles(path, 1_300_000), "enormous mesh"),
    "values": (
        "t.json",
        lambda path: path.write_bytes(b"[" + b"[]," * 3_000_000 + b"1]"),
        " 1000000 ",
    ),
    "letters": (
        "t.json",
        lambda path: path.write_bytes(b'["' + "\U0001f600".encode() * 10_000_000 + b'"]'),
        "`format`",
    ),
}
ALWAYS = ("triangles", "values")
"""The others are for the night: each takes a program's start."""


@pytest.mark.parametrize(
    "case",
    [pytest.param(case, marks=() if case in ALWAYS else SLOW) for case in CASES],
)
def test_a_hostile_file(tmp_path: Path, case: str) -> None:
    name, make, words = CASES[case]
    path = given = tmp_path / name
    make(path)
    size = path.stat().st_size if path.is_file() else 0
    data = sample_data()
    match path.suffix:
        case ".urdf":
            data["robots"][0]["urdf"] = name
            given = write(tmp_path, data)
        case ".stl":
            data["environment"][0] = {"name": "m", "kind": "mesh", "path": name}
            given = write(tmp_path, data)
    program = ["replay"] if path.suffix == ".json" else ["inspect", "--no-pictures"]
    said = refused(size, *program, str(given))
    assert words in said
    assert name in said or given.name in said


@pytest.mark.parametrize(
    ("program", "further"), [("compare", "{0}"), pytest.param("report", "--quiet", marks=SLOW)]
)
def test_a_hostile_results_folder(tmp_path: Path, program: str, further: str) -> None:
    os.mkfifo(tmp_path / "configuration.json")
    said = refused(0, program, str(tmp_path), further.format(tmp_path))
    assert f"{tmp_path}/configuration.json" in said


@pytest.mark.slow
def test_random_damage_given_to_the_program() -> None:
    """Random candidates are judged where the damaged cell is one; it is compiled then."""
    sound = RACK.read_bytes().replace(b"../robots/gofa12.urdf", b"arm.urdf")

    @settings(max_examples=40, suppress_health_check=list(HealthCheck))
    @given(
        st.one_of(byte_damage(), st.just(lambda text: text)), st.one_of(byte_damage(), xml_damage())
    )
    def check(of_cell: Bytes, of_urdf: Bytes) -> None:
        with tempfile.TemporaryDirectory() as folder:
            (Path(folder) / "cell.toml").write_bytes(of_cell(sound))
            (Path(folder) / "arm.urdf").write_bytes(of_urdf(GOFA.read_bytes()))
            arguments = [f"{folder}/cell.toml", "--no-pictures", "--candidates", "2"]
            code, said, _ = ended("inspect", *arguments)
            assert code in (0, 2), said
            assert "Traceback" not in said, said
            assert (code == 0) == (not said.strip())

    check()
