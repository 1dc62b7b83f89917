"""The budget of a grip against models of changed cells that are built anew."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hybrid_opt.carry import BoxMotion
from hybrid_opt.robust.budget import (
    GripBudget,
    budget_text,
    cheapest_remedies,
    grip_budget,
)
from hybrid_opt.robust.force import interpreted_robust_model
from symbolic.contact.registry import command_model
from symbolic.read.cell import changed
from symbolic.records import USUAL_UNCERTAINTY, Workcell
from symbolic.records.cell import RANGES
from tests.hybrid_opt import cells

GRAVITY = 9.81


@pytest.fixture(scope="module")
def rack() -> Workcell:
    """The rack, of whose robots the usual uncertainty asks too much."""
    return replace(cells.shipped("rack").workcell, uncertainty=USUAL_UNCERTAINTY)


def test_it_is_what_friction_and_weight_say(rack: Workcell) -> None:
    """With pads at the height of the centre of mass and no disturbance the load is the weight."""
    doubt = replace(
        USUAL_UNCERTAINTY,
        centre_of_mass=np.zeros(3),
        disturbance=np.zeros(3),
        relative_position=0.0,
        pad_position=0.0,
    )
    level = changed(
        rack,
        {
            "contacts[0].xyz": [0.0, 0.2, 0.0],
            "contacts[1].xyz": [0.0, -0.2, 0.0],
            "payload.centre_of_mass": [0.0, 0.0, 0.0],
        },
    )
    budget = grip_budget(replace(level, uncertainty=doubt))
    friction = command_model(replace(level, uncertainty=doubt)).least_friction(doubt).min()
    weight = GRAVITY * level.payload.mass * (1.0 + doubt.mass)
    force = (weight / (2.0 * friction) + doubt.internal_force / friction) / (1.0 - doubt.tracking)
    np.testing.assert_allclose(budget.required, force, rtol=2e-3)


@settings(max_examples=settings().max_examples // 5)
@given(st.floats(4.0, 15.0), st.floats(1.01, 1.3))
def test_more_payload_takes_more_force(mass: float, more: float) -> None:
    workcell = cells.shipped("rack").workcell
    light, heavy = (
        grip_budget(replace(workcell, payload=replace(workcell.payload, mass=each)))
        for each in (mass, more * mass)
    )
    assert (heavy.required > light.required).all()


def numbers(text: str) -> list[float]:
    """All numbers of a text."""
    return [float(each) for each in re.findall(r"[0-9]+\.?[0-9]*", text)]


def test_remedies_do_and_a_little_less_does_not(rack: Workcell) -> None:
    """By cells that are read anew with them, for each kind of remedy."""
    model, allowed = interpreted_robust_model(rack), rack.task.reference_force
    poses = np.array([rack.task.waypoints[0].lower, rack.task.waypoints[-1].lower])
    motion = BoxMotion(poses, np.zeros_like(poses), np.zeros_like(poses))
    required = grip_budget(rack).required
    remedies = cheapest_remedies(model, motion, required, allowed, most=100)
    told = {each.change.rstrip("0123456789. "): each for each in remedies}
    ranges = {
        f"uncertainty.{name}": getattr(USUAL_UNCERTAINTY, name) for name in (*RANGES, "stiffness")
    }

    def cell(**changes: object) -> GripBudget:
        return grip_budget(changed(rack, {**ranges, **changes}))

    def both(name: str, value: float, worse: float) -> None:
        assert cell(**{name: value}).fits, (name, value)
        assert not cell(**{name: value + worse}).fits, (name, value)

    by_kind = {}
    for each in remedies:
        for kind in ("reference force", "mass of", "friction of ", "every range", "friction off"):
            if kind in each.change:
                by_kind[kind] = numbers(each.change)[0]
    assert len(by_kind) == 5, told
    both("task.reference_force", by_kind["reference force"], -0.2)
    both("payload.mass", by_kind["mass of"], 0.03)
    both("contacts.friction", by_kind["friction of "], -0.01)
    both("uncertainty.friction", by_kind["friction off"] / 100.0, 0.004)
    scaled = USUAL_UNCERTAINTY.scaled(by_kind["every range"])
    assert grip_budget(replace(rack, uncertainty=scaled)).fits
    assert not grip_budget(
        replace(rack, uncertainty=USUAL_UNCERTAINTY.scaled(by_kind["every range"] + 0.02))
    ).fits
    assert [abs(each.share) for each in remedies] == sorted(abs(each.share) for each in remedies)
    assert grip_budget(rack).remedies == remedies[:3]


def test_it_is_told_with_its_numbers(rack: Workcell) -> None:
    text = budget_text(rack)
    assert " 120.0 N of 117.7 N" in text
    assert text.count("(") == 3
    fitting = budget_text(cells.shipped("rack").workcell)
    assert all(told in fitting for told in ("[uncertainty]", " 92.9 N of 117.7 N", " 21 %"))
    none = replace(rack, uncertainty=replace(USUAL_UNCERTAINTY, friction=0.99))
    assert "117.7 N" not in budget_text(none)
