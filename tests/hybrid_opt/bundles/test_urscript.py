"""The URScript programs, read as the Python that they nearly are, and run against a mock arm."""

from __future__ import annotations

import ast
import re
from typing import Any

import numpy as np
import pytest

from hybrid_opt.bundles.manifest import BundleOptions
from hybrid_opt.bundles.urscript import urscript_files
from hybrid_opt.job.records import sample_job
from symbolic.errors import SettingsError
from tests.hybrid_opt.bundles.bundles import contents, sampled, text_of
from tests.hybrid_opt.job.jobs import rack_job

BLOCK = re.compile(r"^(\s*)(def|if|while|elif|else)\b.*:$")


def as_python(script: str) -> ast.Module:
    """The program as Python's parser reads it: blocks end by `end`, poses are lists.

    Every `end` has to stand where the block begins that it closes.
    """
    lines, opened = [], []
    for line in script.splitlines():
        code = line.split("#")[0].rstrip()
        found = BLOCK.match(code)
        if found:
            opened.append(len(found[1]))
        if code.strip() == "end":
            assert len(code) - len("end") == opened.pop()
            continue
        lines.append(re.sub(r"\bp\[", "[", code))
    assert not opened
    return ast.parse("\n".join(lines))


class Arm:
    """What a program calls; its joints are where the last servoj sent them."""

    def __init__(self, start: Any) -> None:
        self.q = list(start)
        self.sent: list[list[float]] = []
        self.times: list[float] = []
        self.forces: list[float] = []
        self.log: list[str] = []
        self.line = False

    def names(self) -> dict[str, Any]:
        def servoj(q: list[float], t: float, lookahead_time: float, gain: float) -> None:
            assert 0.03 <= lookahead_time <= 0.2
            assert 100 <= gain <= 2000
            self.q = q
            self.sent.append(q)
            self.times.append(t)

        def force_mode(frame: Any, selection: Any, wrench: Any, kind: int, limits: Any) -> None:
            assert selection == [0, 0, 1, 0, 0, 0]
            assert kind == 2
            assert len(limits) == 6
            self.forces.append(wrench[2])
            self.log.append("force")

        def out(number: int, level: bool) -> None:
            self.line = level  # the other arm answers at once
            self.log.append(f"line {level}")

        return {
            "servoj": servoj,
            "force_mode": force_mode,
            "end_force_mode": lambda: self.log.append("end force"),
            "zero_ftsensor": lambda: self.log.append("zero"),
            "set_tcp": lambda pose: self.log.append(f"tcp {len(pose)}"),
            "set_target_payload": lambda mass, centre: self.log.append(f"payload {mass:g}"),
            "get_actual_joint_positions": lambda: list(self.q),
            "get_actual_tcp_pose": lambda: [0.0] * 6,
            "set_standard_digital_out": out,
            "get_standard_digital_in": lambda number: self.line,
            "norm": abs,
            "popup": lambda text, blocking: self.log.append("popup"),
            "halt": None,
            "sync": lambda: None,
            "stopj": lambda rate: self.log.append("stop"),
        }


def run(name: str, start: Any) -> Arm:
    names = Arm(start)
    space = names.names()
    exec(compile(as_python(text_of("urscript", name)), name, "exec"), space)
    space["carry_job"]()
    return names


def test_both_programs_stream_the_job_and_press() -> None:
    job = sampled(0.008)
    steps = np.diff(job.time)
    np.testing.assert_allclose(steps, 0.008, atol=1e-9)
    for arm, name in enumerate(contents("urscript")):
        q = job.arm(arm, job.q)
        found = run(name, q[0])
        np.testing.assert_allclose(found.sent, q[1:], atol=1e-7)
        np.testing.assert_allclose(found.times, 0.008, atol=1e-9)
        assert "popup" not in found.log
        assert found.log.count("line True") == len(rack_job().phases)
        assert found.log[0] == "tcp 6"
        assert found.log[-1] == "stop"
        if arm == rack_job().squeeze.leader:
            assert not found.forces
        else:
            assert max(found.forces) == pytest.approx(job.normal_force[:, arm].max(), abs=1.0)
            assert found.forces[-1] == pytest.approx(0.0, abs=1e-3)
            assert found.log.index("zero") < found.log.index("force")
            assert "end force" in found.log


def test_an_arm_elsewhere_is_not_moved_unasked() -> None:
    found = run(next(iter(contents("urscript"))), sampled(0.008).q[0, :6] + 0.1)
    assert "popup" in found.log


def test_other_arms_and_steps_are_refused() -> None:
    with pytest.raises(SettingsError, match="UR e-series"):
        urscript_files(sampled(0.008), BundleOptions())
    with pytest.raises(SettingsError, match="time step"):
        urscript_files(sample_job(rack_job(), 0.05), BundleOptions(any_arm=True))
