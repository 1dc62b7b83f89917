"""A contact model is one file: one from here is read, searched, polished, timed, recommended and
reported like those that ship."""

from __future__ import annotations

from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from codegen.cache import Cache
from codegen.interpreted import InterpretedFunction
from hybrid_opt.campaign import CampaignSettings, ExecutionSettings
from hybrid_opt.carry import BoxMotion, motion_inputs
from hybrid_opt.polishing.settings import (
    DrivableSettings,
    FillSettings,
    PolishSettings,
    ProbeSettings,
)
from hybrid_opt.progress import Progress
from hybrid_opt.robust.force import interpreted_robust_model
from studies.programs.study import StudySettings, run_study
from studies.report import PAGE
from studies.study.recommendation import read_recommendation
from symbolic.array import Array
from symbolic.contact.load import load_function
from symbolic.contact.model import ContactLoad, ContactModel, HeldLoad, ImplicitVariables, Problem
from symbolic.contact.registry import CONTACT_MODELS
from symbolic.errors import WorkcellError
from symbolic.expression import Expression
from symbolic.read.cell import load
from symbolic.records import Uncertainty, Workcell
from symbolic.records.quantities import GRAVITY
from tests.refusals import refused
from tests.symbolic.cells import RACK

NAME = "halves"


class Halves(ContactModel):
    """Two magnets, each of which bears half of the load. What counts as the normal force is the
    holding force that half the load needs: |F_n| / 2 against lifting, |F_t| / (2 mu) against
    sliding. Neither presses the other."""

    assumption = "magnets that bear half of the load each"

    @property
    def problem(self) -> Problem | None:
        """See `ContactModel`."""
        if self.workcell.payload.mass < 50.0:
            return None
        return "payload.mass", "is too much for magnets"

    def hold(
        self,
        load: ContactLoad,
        implicit: ImplicitVariables | None = None,
        displaced: bool = False,
    ) -> HeldLoad:
        """See `ContactModel`."""
        half, normal = load.force / 2.0, load.axes[:, 2]
        across = ca.dot(half, normal)
        rubbed = ca.sqrt(ca.sumsqr(half - across * normal) + 1e-18)
        lifted = ca.sqrt(across**2 + 1e-18)
        needed = [lifted + rubbed / load.friction[i] for i in (0, 1)]
        point = load.moment - sum(ca.cross(arm, half) for arm in load.arms)
        none = ca.SX.zeros(3)
        return HeldLoad(
            ca.vertcat(*needed),
            ca.vertcat(rubbed, rubbed),
            (half, half),
            (none, none),
            (point / 2.0, point / 2.0),
            point,
            none,
        )

    def commanded_forces(
        self, normal: Expression, friction: Expression, tracking: Expression, opposed: Expression
    ) -> Expression:
        """See `ContactModel`. Each holds by itself."""
        return ca.vertcat(
            *[(normal[i] + opposed / friction[i]) / (1.0 - tracking[i]) for i in (0, 1)]
        )

    @property
    def leading_share(self) -> Array:
        """See `ContactModel`."""
        return np.zeros(2)

    def leading_excess(self, load: ContactLoad, opposed: Expression) -> Expression:
        """See `ContactModel`."""
        return self.hold(load).normal[0] + opposed / load.friction[0]

    def internal_force_ratio(self, leader: int) -> Array:
        """See `ContactModel`."""
        return np.asarray(np.eye(2)[1 - leader])


@pytest.fixture
def workcell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Workcell:
    """The rack, held by this file's model, read from a file of its own."""
    monkeypatch.setitem(CONTACT_MODELS, NAME, Halves)
    return load(written(tmp_path))


def written(folder: Path, mass: float | None = None) -> Path:
    """A workcell file that names the model."""
    text = RACK.read_text("utf-8")
    assert "[task]\n" in text
    text = text.replace("[task]\n", f'[task]\nallocation = "{NAME}"\n', 1)
    text = text.replace('urdf = "../', f'urdf = "{RACK.parent.parent}/')
    if mass is not None:
        text = text.replace("mass = 10.0", f"mass = {mass}", 1)
    path = folder / "halves.toml"
    path.write_text(text, "utf-8")
    return path


@pytest.fixture
def motion() -> BoxMotion:
    """A box that is accelerated any way and does not turn."""
    rng = np.random.default_rng(5)
    pose, second = np.zeros((20, 6)), np.zeros((20, 6))
    second[:, :3] = rng.uniform(-3.0, 3.0, (20, 3))
    return BoxMotion(pose, np.zeros((20, 6)), second)


def test_its_forces_are_those_of_a_motion(workcell: Workcell, motion: BoxMotion) -> None:
    out = InterpretedFunction(load_function(workcell)).batch(*motion_inputs(motion))
    force = workcell.payload.mass * (motion.second_rate[:, :3] - np.array(GRAVITY))
    np.testing.assert_allclose(out["contact_force"], np.hstack([force / 2.0] * 2), atol=1e-9)
    normal = workcell.contacts[0].T_box_pad[:3, 2]
    along = force @ normal
    across = np.linalg.norm(force - np.multiply.outer(along, normal), axis=1)
    for robot, contact in enumerate(workcell.contacts):
        needed = np.abs(along) / 2.0 + across / (2.0 * contact.friction)
        np.testing.assert_allclose(out["normal_force"][:, robot], needed, rtol=1e-6)


def test_its_robust_forces_hold_each_arm_for_itself(workcell: Workcell, motion: BoxMotion) -> None:
    model = interpreted_robust_model(workcell)
    planned = model.nominal(motion)
    heavier = Uncertainty(mass=0.2, tracking=0.05, stated=True)
    for leader in (0, 1):
        commanded, felt = model.hold(motion, heavier, leader)
        np.testing.assert_allclose(felt, 1.2 * planned[:, leader], rtol=1e-6)
        np.testing.assert_allclose(commanded, 1.2 * planned[:, 1 - leader] / 0.95, rtol=1e-6)


def test_its_problem_is_the_file_s(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(CONTACT_MODELS, NAME, Halves)
    with refused(WorkcellError, "workcell", "payload.mass: "):
        load(written(tmp_path, mass=60.0))


@pytest.mark.slow
@pytest.mark.compiled
def test_its_carries_are_studied_to_the_recommendation(
    workcell: Workcell, tmp_path: Path, cache: Cache
) -> None:
    results = tmp_path / "results"
    polish = PolishSettings(
        attempts=1,
        rounds=2,
        probe=ProbeSettings(1, 1, rounds=1),
        fill=FillSettings(solved=2, members=2, attempts=1),
        drivable=DrivableSettings(first_rounds=6, rounds=2, members=1),
    )
    campaign = CampaignSettings({"nsga2": {"population": 20}}, evaluations=60, replicas=1, seed=4)
    wanted = StudySettings(polish, drivable_replicas=1, drivable_polish=polish, pdf=False)
    run_study(workcell, campaign, ExecutionSettings(results, jobs=1), Progress(shown=False), wanted)
    assert Halves.assumption in (results / PAGE).read_text("utf-8")
    recommended = read_recommendation(results)
    assert recommended is not None
