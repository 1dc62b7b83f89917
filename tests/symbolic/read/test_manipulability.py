"""The usual least manipulability; the oracles are similar machines and Pinocchio's Jacobians."""

from __future__ import annotations

from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pytest

from symbolic.array import Array
from symbolic.read.arms import link_frame, usual_manipulability
from tests.machines import SINGLE, example_robot
from tests.symbolic.cells import GOFA


def scaled(factor: float) -> pin.Model:
    """Build a GoFa 12 with all lengths times a factor."""
    root = ElementTree.parse(GOFA).getroot()
    for origin in root.iter("origin"):
        xyz = np.array(origin.get("xyz", "0 0 0").split(), dtype=float)
        origin.set("xyz", " ".join(map(repr, (factor * xyz).tolist())))
    return pin.buildModelFromXML(ElementTree.tostring(root, encoding="unicode"))


def manipulabilities(model: pin.Model, flange: str) -> Array:
    """Compute abs(det J) of random postures within limits [m^3]."""
    data, rng = model.createData(), np.random.default_rng(0)
    low, high = np.clip([model.lowerPositionLimit, model.upperPositionLimit], -np.pi, np.pi)
    frame, found = link_frame(model, flange), []
    for _ in range(600):
        J = pin.computeFrameJacobian(model, data, rng.uniform(low, high), frame, pin.LOCAL)
        found.append(abs(np.linalg.det(J)))
    return np.array(found)


@pytest.mark.parametrize("factor", [0.3, 1.0, 2.0])
def test_it_scales_as_the_manipulability_does(factor: float) -> None:
    own, other = scaled(1.0), scaled(factor)
    share = manipulabilities(other, "tool0") / manipulabilities(own, "tool0")
    np.testing.assert_allclose(share, factor**3, rtol=1e-9)
    usual = usual_manipulability(other, "tool0") / usual_manipulability(own, "tool0")
    assert usual == pytest.approx(factor**3, rel=0.03), "two digits"


@pytest.mark.parametrize("name", ["ur3", "ur5", "ur10"])
def test_most_postures_of_small_and_large_arms_are_above_it(name: str) -> None:
    model = pin.buildModelFromUrdf(str(example_robot(SINGLE[name].urdf)))
    share = np.mean(manipulabilities(model, "tool0") < usual_manipulability(model, "tool0"))
    assert 0.05 < share < 0.30
