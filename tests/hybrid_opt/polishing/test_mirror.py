"""Mirror images: an involution, exact on a symmetric cell, absent where there is none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hybrid_opt.polishing.mirror import mirror_of
from tests.hybrid_opt.polishing.test_front import evaluator


def test_an_image_is_as_good_with_exchanged_objectives() -> None:
    mirror = mirror_of(evaluator().workcell)
    assert mirror is not None
    rng = np.random.default_rng(7)
    x = rng.uniform(evaluator().lower, evaluator().upper, (600, evaluator().n_var))
    found = [mirror.image(row) for row in x]
    images = np.array([image for image in found if image is not None])
    assert len(images) == len(x)
    before, after = evaluator().evaluate(x), evaluator().evaluate(images)
    np.testing.assert_array_equal(after.feasible, before.feasible)
    assert before.feasible.sum() > 5
    good = before.feasible
    np.testing.assert_allclose(
        after.objectives[good], before.objectives[good][:, ::-1], rtol=0.0, atol=1e-9
    )


def test_the_image_of_an_image_is_the_original() -> None:
    mirror = mirror_of(evaluator().workcell)
    assert mirror is not None
    x = np.random.default_rng(8).uniform(evaluator().lower, evaluator().upper)
    image = mirror.image(x)
    assert image is not None
    again = mirror.image(image)
    assert again is not None
    assert again == pytest.approx(x, abs=1e-12)
    assert np.abs(image - x).max() > 0.0


def test_an_image_beyond_the_bounds_is_none() -> None:
    workcell = evaluator().workcell
    mirror = mirror_of(workcell)
    assert mirror is not None
    lower = mirror.task.lower.copy()
    x = mirror.task.upper.copy()
    assert mirror.image(x) is not None
    free = next(k for k, w in enumerate(workcell.task.waypoints) if not w.is_fixed)
    narrow = list(workcell.task.waypoints)
    narrow[free] = replace(narrow[free], lower=narrow[free].lower + 0.01 * np.eye(6)[1])
    tight = mirror_of(replace(workcell, task=replace(workcell.task, waypoints=tuple(narrow))))
    assert tight is not None
    assert (tight.task.lower > lower).any()
    assert tight.image(x) is None


def test_cells_without_a_plane_have_no_image() -> None:
    workcell = evaluator().workcell
    first, second = workcell.robots
    moved = first.T_world_base.copy()
    moved[0, 3] += 0.1
    askew = replace(workcell, robots=(replace(first, T_world_base=moved), second))
    assert mirror_of(askew) is None
    moved = first.T_world_base.copy()
    moved[1, 3] += 0.1
    # The plane is elsewhere then: the ends of the path are not in it.
    uneven = replace(workcell, robots=(replace(first, T_world_base=moved), second))
    assert mirror_of(uneven) is None
