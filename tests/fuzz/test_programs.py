"""Hostile files given to the real programs: one message, exit code 2, soon, in little memory."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from threading import Timer
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from symbolic.outside import MEBIBYTE
from tests.fuzz.damage import Bytes, byte_damage, xml_damage
from tests.symbolic.cells import ROOT
from tests.symbolic.read.samples import GOFA, RACK, sample_data, write
from tests.waiting import soon

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


def few(kinds: Iterable[Any], kept: Any) -> list[Any]:
    """All of them for the night, one of them always: each takes a program's start."""
    return [pytest.param(kind, marks=() if kind == kept else pytest.mark.slow) for kind in kinds]


@cache
def idle(program: str) -> int:
    """Memory of a program that is given nothing [bytes]."""
    return ended(program, "nowhere")[2]


def refused(program: str, size: int, *arguments: str) -> str:
    """The message with which a program refuses files of this size [bytes] together."""
    code, said, memory = ended(program, *arguments)
    assert code == 2, said
    assert "Traceback" not in said, said
    assert said.strip()
    assert memory - idle(program) < 10 * size + 300 * MEBIBYTE
    return said


def chain(links: int) -> str:
    parts = ['<robot name="r"><link name="l0"/>']
    for k in range(1, links):
        ends = f'<parent link="l{k - 1}"/><child link="l{k}"/>'
        parts.append(f'<link name="l{k}"/><joint name="j{k}" type="fixed">{ends}</joint>')
    return "".join(parts) + "</robot>"


WORKCELLS: dict[str, tuple[Callable[[Path], Any], str]] = {
    "a pipe": (lambda path: os.mkfifo(path), "it is a pipe"),
    "a device": (lambda path: path.symlink_to("/dev/zero"), "it is a device"),
    "tens of megabytes": (lambda path: path.write_bytes(b"a = 1\n" * 2**23), "is too large"),
    "empty tables": (lambda path: path.write_bytes(b"[[a]]\n" * 170_000), "a: unknown key"),
    "dotted keys": (lambda path: path.write_bytes(b"a." * 400_000 + b"a = 1"), "50 parts"),
    "digits": (lambda path: path.write_bytes(b"a = " + b"9" * 900_000), "4300 digits"),
    "hexadecimal digits": (
        lambda path: path.write_bytes(b"name = 0x" + b"f" * 900_000),
        "name: found a number of 3600000 bits",
    ),
    "brackets": (lambda path: path.write_bytes(b"a = " + b"[" * 900_000), "nested too deeply"),
}


@pytest.mark.parametrize("kind", few(WORKCELLS, "a device"))
def test_a_hostile_workcell(tmp_path: Path, kind: str) -> None:
    make, words = WORKCELLS[kind]
    path = tmp_path / "cell.toml"
    make(path)
    size = path.stat().st_size if path.is_file() else 0
    said = refused("inspect", size, str(path), "--no-pictures")
    assert words in said
    assert "cell.toml" in said


URDFS: dict[str, tuple[Callable[[], str], str]] = {
    "a chain": (lambda: chain(50_000), "more than 100000 elements"),
    "a shorter chain": (lambda: chain(20_000), "has 20000 links"),
    "shapes": (
        lambda: GOFA.read_text().replace(
            "</link>",
            "<collision><geometry><sphere radius='0.1'/></geometry></collision>" * 3000 + "</link>",
            1,
        ),
        "raise collision.most_pieces",
    ),
    "a box of 1e300 m": (
        lambda: GOFA.read_text().replace("0.205 0.2 0.03", "1e300 1 1"),
        "geometry/box size[0]: found 1e+300",
    ),
    "attributes": (
        lambda: "<robot><link " + " ".join(f"a{k}='1'" for k in range(500_000)) + "/></robot>",
        "link[0] name: is missing",
    ),
    "one long text": (lambda: f"<robot name='{'x' * 15_000_000}'/>", "has no links"),
}


@pytest.mark.parametrize("kind", few(URDFS, "a chain"))
def test_a_hostile_urdf(tmp_path: Path, kind: str) -> None:
    make, words = URDFS[kind]
    (tmp_path / "arm.urdf").write_text(make())
    data = sample_data()
    data["robots"][0]["urdf"] = "arm.urdf"
    path = write(tmp_path, data)
    size = (tmp_path / "arm.urdf").stat().st_size
    said = refused("inspect", size, str(path), "--no-pictures")
    assert words in said
    assert "robots[0].urdf: " in said


@pytest.mark.parametrize("triangles", few([3000, 190_000, 1_300_000], 190_000))
def test_a_hostile_mesh(tmp_path: Path, triangles: int) -> None:
    rng = np.random.default_rng(1)
    kind = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
    content = np.zeros(triangles, kind)
    content["corners"] = rng.uniform(-0.5, 0.5, (triangles, 3, 3))
    mesh = tmp_path / "m.stl"
    mesh.write_bytes(b"\0" * 80 + np.uint32(triangles).tobytes() + content.tobytes())
    data = sample_data()
    data["environment"][0] = {"name": "m", "kind": "mesh", "path": "m.stl"}
    path = write(tmp_path, data)
    said = refused("inspect", mesh.stat().st_size, str(path), "--no-pictures")
    assert "m.stl" in said
    assert "separate parts" in said or "enormous mesh" in said


TRAJECTORIES: dict[str, tuple[bytes, str]] = {
    "values": (b"[" + b"[]," * 3_000_000 + b"1]", "more than 1000000 values"),
    "texts": (b"[" + b'"a" ' * 5_000_000 + b"]", "more than 1000000 values"),
    "one long text": (b'["' + b"x" * 100_000_000 + b'"]', "`format` is not"),
    "astral letters": (b'["' + "\U0001f600".encode() * 10_000_000 + b'"]', "`format` is not"),
    "depth": (b"[" * 10_000_000, "holds more than"),
    "infinite": (b'{"format": 1e999}', "no finite number"),
}


@pytest.mark.parametrize("kind", few(TRAJECTORIES, "values"))
def test_a_hostile_trajectory(tmp_path: Path, kind: str) -> None:
    content, words = TRAJECTORIES[kind]
    path = tmp_path / "t.json"
    path.write_bytes(content)
    said = refused("replay", len(content), str(path))
    assert words in said
    assert "t.json" in said


@pytest.mark.parametrize("kind", few(["empty", "list", "pipe"], "pipe"))
def test_a_hostile_results_folder(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "results" / "configuration.json"
    path.parent.mkdir()
    if kind == "pipe":
        os.mkfifo(path)
    else:
        path.write_text(json.dumps({} if kind == "empty" else []))
    for program, arguments in (("compare", [str(tmp_path / "results")] * 2), ("report", [])):
        said = refused(program, 0, *(arguments or [str(tmp_path / "results"), "--quiet"]))
        assert "configuration.json" in said


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
