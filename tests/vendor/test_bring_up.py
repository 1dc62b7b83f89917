"""The unedited `run_egm.py --bring-up` over UDP, in messages of ABB's own egm.proto."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from hybrid_opt.extras.bundles.programs.bring_up import BLOCK, FILE
from tests.hybrid_opt.extras.bundles.test_abb import CYCLE, STIFFNESS
from tests.vendor.egm import LAG, LOCAL, SIGN, Controllers
from tests.vendor.short import egm

pytestmark = pytest.mark.vendor

REAL = 3.0 * STIFFNESS
"""Stiffness of the arms, which are planned to be softer [N/m]."""


def test_arms_are_measured_and_the_job_is_refused(tmp_path: Path) -> None:
    """In the air and back, then on a block: the lag is that of the arms and up to three cycles of
    messages."""
    controllers = Controllers(egm(LOCAL, True).files, tmp_path, REAL, arguments=["--bring-up"])
    try:
        controllers.is_empty = True
        controllers.run(lambda: BLOCK in controllers.said())
        controllers.is_empty = False
        controllers.command("press")
        controllers.run(lambda: False)
        said = controllers.said()
        assert controllers.program.returncode == 2, said
        assert f" {STIFFNESS:.0f}" in said
        assert f"--driver {tmp_path / FILE}" in said
        arms = tomllib.loads((tmp_path / FILE).read_text("utf-8"))["robots"]
        for arm in arms:
            assert LAG < arm["measured"]["lag"] < LAG + 3.0 * CYCLE
            assert arm["driver"]["stiffness"] == pytest.approx(REAL, rel=0.05)
        assert arms[controllers.pressing]["measured"]["sign"] == SIGN
        largest = max(controllers.job.robots[controllers.pressing]["normal_force"])
        assert max(row[1] for row in controllers.record) < 1.5 * largest
    finally:
        controllers.program.kill()
        controllers.program.wait()
