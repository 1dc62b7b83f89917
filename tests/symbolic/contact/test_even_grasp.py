"""Pads that press evenly at any pose, as loads and in uncertain cases."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import clarabel
import numpy as np
import pytest
from scipy import sparse
from scipy.spatial.transform import Rotation

from codegen.lanes import lane_text
from codegen.source import generated_c
from studies.research.plain.motion import GRAVITY, angular_rates, rotation
from symbolic.array import Array
from symbolic.contact.even_patch import EvenPatch
from symbolic.contact.force_closure import scaled_patch
from symbolic.contact.grasp import Grasp, grasp_wrenches
from symbolic.contact.load import load_function
from symbolic.contact.soft_finger import SoftPatch, least_soft_squeeze
from symbolic.contact.soft_grasp import SoftGrasp
from symbolic.contact.worst_cases import CASE_SIZE, case_squeeze_function
from symbolic.records import Contact, Workcell
from tests.symbolic.cells import call, hand_cell, with_task
from tests.symbolic.contact.grasp_oracle import (
    effort,
    function_of,
    in_box,
    least_wrenches,
    random_grasp,
    random_load,
    wrenches,
)
from tests.symbolic.contact.joint_oracle import Case
from tests.symbolic.contact.joint_oracle import least_wrenches as joint_wrenches
from tests.symbolic.contact.test_joint_allocation import needed
from tests.symbolic.contact.test_payload_load import random_cell, random_motion

KINDS = (
    ("round", "round"),
    ("round", "rectangle"),
    ("round", "round", "round"),
    ("rectangle",) * 4,
)


def even_cell() -> Workcell:
    return with_task(hand_cell(), allocation="soft-finger")


def points_of(pad: Contact) -> tuple[Array, Array]:
    """(m, 2) points of a patch and the shares (m,) of the area that they stand for."""
    if pad.half_sides is not None:
        along = (np.arange(12) + 0.5) / 6 - 1.0
        points = np.array(np.meshgrid(*[half * along for half in pad.half_sides]))
        return points.reshape(2, -1).T, np.full(144, 1.0 / 144)
    r, angle = np.meshgrid((np.arange(8) + 0.5) / 8, (np.arange(12) + 0.5) * 2.0 * np.pi / 12)
    at = np.stack([r * np.cos(angle), r * np.sin(angle)], axis=-1)
    return pad.patch_radius * at.reshape(-1, 2), r.ravel() / r.sum()


def area_of(pad: Contact) -> float:
    if pad.half_sides is None:
        return np.pi * pad.patch_radius**2
    return 4.0 * pad.half_sides[0] * pad.half_sides[1]


def least_on_grids(pads: tuple[Contact, ...], load: Array, fork: bool = False) -> Array:
    """(k, 6) as `wrenches`, of the least effort with friction at every point of a grid and pressure
    that is the same all over each patch; on a fork also all over the first two."""
    size = float(np.linalg.norm(load[:3]) + 10.0 * np.linalg.norm(load[3:]))
    maps, cones, ends = [], [], [0]
    for pad in pads:
        points, share = points_of(pad)
        # Normal force, then the tangential force at every point over the normal force's share.
        own = np.zeros((6, 1 + 2 * len(points)))
        own[2, 0] = 1.0
        for k, (point, part) in enumerate(zip(points, share, strict=True)):
            at = 1 + 2 * k
            own[0, at] = own[1, at + 1] = part
            own[5, at : at + 2] = part * np.array([-point[1], point[0]])
        maps.append(own)
        cone = np.zeros((3 * len(points), own.shape[1]))
        for k in range(len(points)):
            cone[3 * k, 0] = pad.friction
            cone[3 * k + 1 : 3 * k + 3, 1 + 2 * k : 3 + 2 * k] = np.eye(2)
        cones.append(cone)
        ends.append(ends[-1] + own.shape[1])
    # The pads' wrenches are unknowns of their own: the effort is theirs.
    k, whole = 6 * len(pads), sparse.block_diag(maps)
    balance, asked = np.hstack([in_box(pad) for pad in pads]), load / size
    if fork:
        row = np.zeros(k)
        row[[2, 8]] = 1.0 / area_of(pads[0]), -1.0 / area_of(pads[1])
        balance, asked = np.vstack([balance, row]), np.append(asked, 0.0)
    count = sum(len(cone) for cone in cones)
    rows = [
        [sparse.csc_matrix(balance), None],
        [sparse.eye(k), -whole],
        [None, -sparse.block_diag(cones)],
    ]
    options = clarabel.DefaultSettings()
    options.verbose = False
    solution = clarabel.DefaultSolver(
        sparse.diags([*np.tile([1.0, 1, 1, 0, 0, 0], len(pads)), *np.zeros(ends[-1])]).tocsc(),
        np.zeros(k + ends[-1]),
        sparse.bmat(rows).tocsc(),
        np.concatenate([asked, np.zeros(k + count)]),
        [clarabel.ZeroConeT(len(asked) + k), *[clarabel.SecondOrderConeT(3)] * (count // 3)],
        options,
    ).solve()
    assert str(solution.status) in ("Solved", "AlmostSolved"), solution.status
    return size * np.array(solution.x)[:k].reshape(-1, 6)


@pytest.mark.parametrize("kinds", KINDS)
def test_the_least_effort_is_that_of_grids_of_points(kinds: tuple[str, ...]) -> None:
    """Within what (1) of `soft_finger` is from the exact limit surface: rectangles of up to 12 to 1
    are among them."""
    rng = np.random.default_rng(4)
    for _ in range(2):
        cell = random_grasp(rng, even_cell(), kinds)
        load = random_load(rng)
        found, expected = wrenches(cell, load), least_on_grids(cell.pads, load)
        balance = sum(in_box(p) @ w for p, w in zip(cell.pads, found, strict=True))
        np.testing.assert_allclose(balance, load, atol=1e-9 * np.sqrt(effort(found)))
        ratio = np.sqrt(effort(found) / effort(expected))
        least, most = (0.985, 1.04) if "rectangle" in kinds else (0.99, 1.01)
        assert least < ratio < most, ratio


@pytest.mark.parametrize("alike", [True, False])
def test_pads_of_a_fork_press_with_one_pressure(alike: bool) -> None:
    """Side by side on one arm; with the load nearer to one of them the other could press less, and
    does where their normals differ."""
    rng = np.random.default_rng(5)
    first, second = even_cell().contacts
    T = first.T_box_pad.copy()
    T[:3, 3] += T[:3, :3] @ [0.0, 0.08, 0.0]
    if not alike:
        T[:3, :3] = T[:3, :3] @ Rotation.from_euler("x", 0.02).as_matrix()
    pads = (replace(first, patch_radius=0.03), replace(first, T_box_pad=T, patch_radius=0.02))
    cell = replace(even_cell(), contacts=(replace(pads[0], further=(pads[1],)), second))
    function = function_of(cell)
    for _ in range(3):
        load = random_load(rng) * [1, 1, 1, 0.3, 0.3, 0.3]
        found = wrenches(cell, load, function)
        balance = sum(in_box(p) @ w for p, w in zip(cell.pads, found, strict=True))
        np.testing.assert_allclose(balance, load, atol=1e-9 * np.sqrt(effort(found)))
        pressures = found[:2, 2] / [area_of(pad) for pad in pads]
        assert (abs(pressures[0] / pressures[1] - 1.0) < 1e-9) == alike
        expected = least_on_grids(cell.pads, load, fork=alike)
        assert 0.985 < np.sqrt(effort(found) / effort(expected)) < 1.01


def test_two_opposite_pads_press_as_in_closed_form() -> None:
    """Also unequal ones of different shapes, with the load off the line between them."""
    rng = np.random.default_rng(8)
    first, second = even_cell().contacts
    pads = (
        replace(first, friction=0.7, patch_radius=0.03),
        replace(second, friction=0.9, patch_radius=0.05, half_sides=(0.04, 0.03)),
    )
    cell = replace(even_cell(), contacts=pads)
    function, axes = function_of(cell), first.T_box_pad[:3, :3]
    arms = [ca.DM(axes.T @ pad.T_box_pad[:3, 3]) for pad in pads]
    patches = [SoftPatch.of(pad, axes) for pad in pads]
    for _ in range(8):
        load = random_load(rng) * [1, 1, 1, 0.3, 0.3, 0.3]
        force, moment = (ca.SX(ca.DM(axes.T @ part)) for part in (load[:3], load[3:]))
        found = least_soft_squeeze(
            force, moment, (arms[0], arms[1]), ca.SX([0.7, 0.9]), (patches[0], patches[1])
        )
        expected = np.array(ca.evalf(found.normal)).ravel()
        np.testing.assert_allclose(wrenches(cell, load, function)[:, 2], expected, rtol=1e-5)


def test_a_block_on_a_wedge_of_pads_is_held_as_statics_say() -> None:
    """Two pads whose normals stand at 90 degrees below a block need no friction: each bears its
    share of the weight over the root of two. Lifted instead, by pads on adjacent faces, each
    tangential force is at most friction times the normal one."""
    z = 2**-0.5
    places = ((-0.1, 0.0, -0.1), (0.1, 0.0, -0.1), (0.0, 0.0, 0.1))
    normals = ((z, 0.0, z), (-z, 0.0, z), (0.0, 0.0, -1.0))
    pads = []
    for place, normal in zip(places, normals, strict=True):
        T = np.eye(4)
        across = np.array([0.0, 1.0, 0.0])
        T[:3, :3] = np.column_stack([across, np.cross(normal, across), normal])
        T[:3, 3] = place
        pads.append(Contact(T, 0.5, 0.02))
    cell = replace(even_cell(), contacts=(replace(pads[0], further=(pads[1],)), pads[2]))
    found = wrenches(cell, np.array([0.0, 0.0, 80.0, 0.0, 0.0, 0.0]))
    # The least sum of squares lets friction help: no pad on top, both forces upright at 26.6
    # degrees from their normals at most.
    share = 40.0 * np.cos(np.arctan(0.5)) / np.cos(np.pi / 4 - np.arctan(0.5))
    np.testing.assert_allclose(found[:2, 2], share, rtol=1e-4)
    assert found[2, 2] < 1e-3


@pytest.mark.parametrize("kinds", KINDS[:3])
def test_forces_on_the_central_path_have_exact_slopes(kinds: tuple[str, ...]) -> None:
    rng = np.random.default_rng(9)
    cell, load = random_grasp(rng, even_cell(), kinds), random_load(rng)
    soft = SoftGrasp(Grasp(cell), 1e-4)
    first, second = soft.first(), soft.second()
    normal, slope, state = (np.array(value) for value in first(load))
    least = np.bincount(cell.pad_robots, wrenches(cell, load)[:, 2])
    np.testing.assert_allclose(normal.ravel(), least, rtol=5e-3)
    weight, step = np.array([1.0, -0.4]), 1e-3
    curvature = np.array(second(state, weight))
    for k, moved in enumerate(step * np.eye(6) * [1, 1, 1, 0.1, 0.1, 0.1]):
        ends = [first(load + sign * moved) for sign in (1.0, -1.0)]
        size = 2.0 * moved[k]
        by = np.array(ends[0][0] - ends[1][0]).ravel() / size
        np.testing.assert_allclose(by, slope[k], atol=1e-4 * np.abs(slope).max())
        bent = np.array(ends[0][1] - ends[1][1]) @ weight / size
        np.testing.assert_allclose(bent, curvature[k], atol=1e-3 * np.abs(curvature).max())


@pytest.mark.parametrize("kind", ["round", "rectangle"])
def test_a_step_that_counts_as_allowed_stays_within_the_cone(kind: str) -> None:
    rng = np.random.default_rng(3)
    pad = random_grasp(rng, even_cell(), (kind, kind)).pads[0]
    patch = EvenPatch(scaled_patch(pad))
    state, change = ca.SX.sym("s", 4), ca.SX.sym("d", 4)
    look = ca.Function("l", [state, change], [patch.slack(state), patch.lowest(state, change)])
    least = []
    for _ in range(200):
        at = np.array([1.0, *0.6 * rng.uniform(-1, 1, 2), 0.3 * rng.uniform(-1, 1)])
        d = rng.normal(size=4)
        inside, lowest = (float(value) for value in look(at, d))
        if inside <= 0.0:
            continue
        length = min(-1.0 / lowest, 1e3)
        assert float(look(at + (1.0 - 1e-9) * length * d, d)[0]) >= -1e-9
        least.append(float(look(at + 1.05 * length * d, d)[0]))
    # A bound, not the root: most steps that are a little longer leave the cone.
    assert np.mean(np.array(least) <= 0.0) > 0.8


FORKS = (("round", "rectangle"), ("rectangle", "round", "rectangle"))


def held_cell(rng: np.random.Generator, kinds: tuple[str, ...]) -> Workcell:
    return with_task(random_grasp(rng, hand_cell(), kinds), allocation="joint")


def box_load(cell: Workcell, motion: tuple[Array, Array, Array]) -> Array:
    """(6,) force and moment about the box frame's origin that a motion asks for, box axes."""
    force, moment, c = needed(cell, *motion)
    R = rotation(motion[0][3:])
    return np.concatenate([R.T @ force, R.T @ (moment + np.cross(c, force))])


@pytest.mark.parametrize("kinds", FORKS)
def test_agrees_with_clarabel_and_balances_the_motion(kinds: tuple[str, ...]) -> None:
    rng = np.random.default_rng(7)
    for _ in range(3):
        cell, motion = held_cell(rng, kinds), random_motion(rng)
        found = call(load_function(cell), *motion)
        asked = box_load(cell, motion)
        expected = least_wrenches(cell.pads, asked)
        own = [np.array(cell.pad_robots) == i for i in (0, 1)]
        normal = [expected[pads, 2].sum() for pads in own]
        tangential = [np.linalg.norm(expected[pads, :2], axis=1).sum() for pads in own]
        size = np.abs(expected[:, :3]).max()
        np.testing.assert_allclose(found["normal_force"], normal, atol=5e-3 * size)
        np.testing.assert_allclose(found["tangential_force"], tangential, atol=5e-3 * size)
        friction = np.array([contact.friction for contact in cell.contacts])
        assert (found["tangential_force"] <= friction * found["normal_force"]).all()
        # Each robot's wrench about its first pad.
        R = rotation(motion[0][3:])
        total = np.zeros(6)
        for i, contact in enumerate(cell.contacts):
            wrench = found[f"wrench_{i + 1}"]
            force, turning = R.T @ wrench[:3], R.T @ wrench[3:]
            total += np.concatenate([force, turning + np.cross(contact.T_box_pad[:3, 3], force)])
        np.testing.assert_allclose(total, asked, atol=1e-8 * size)
        np.testing.assert_allclose(found["moment_residual"], 0.0, atol=1e-8 * size)
        forces = np.concatenate([found["wrench_1"][:3], found["wrench_2"][:3]])
        np.testing.assert_allclose(found["contact_force"], forces, atol=1e-12 * size)
        radii = [contact.patch_radius for contact in cell.contacts]
        if len(cell.pads) == 2:
            assert (found["pressure_shift"] <= radii).all()


def test_facing_pads_have_the_forces_of_the_joint_allocation() -> None:
    """The general program, asked about two round pads, against the one made for them."""
    rng = np.random.default_rng(3)
    cell = with_task(hand_cell(), allocation="joint")
    motion = random_motion(rng)
    load, friction = ca.MX.sym("load", 6), ca.MX.sym("friction", 2)
    general = ca.Function("grasp", [load, friction], [grasp_wrenches(Grasp(cell), load, friction)])
    wrenches = np.array(general(box_load(cell, motion), [1.0, 1.0])).reshape(2, 6)
    found = call(load_function(cell), *motion)
    np.testing.assert_allclose(wrenches[:, 0], found["normal_force"], rtol=1e-4)


def test_runs_in_lanes() -> None:
    """A batch is evaluated side by side only if every construct of the function is known there."""
    rng = np.random.default_rng(1)
    function = load_function(held_cell(rng, ("round", "rectangle")))
    assert lane_text(generated_c([function]), "grasp") is not None


def test_opposite_rectangles_keep_the_papers_forces_where_they_suffice() -> None:
    """Bit by bit; where a centre of pressure would leave its rectangle they press harder."""
    rng = np.random.default_rng(2)
    paper_cell, kept, pressed = hand_cell(), 0, 0
    for _ in range(12):
        half_x, half_y = (float(half) for half in rng.uniform(0.005, 0.15, 2))
        diagonal = float(np.hypot(half_x, half_y))
        first, second = (
            replace(contact, patch_radius=diagonal, half_sides=(half_x, half_y))
            for contact in paper_cell.contacts
        )
        cell = with_task(replace(paper_cell, contacts=(first, second)), allocation="joint")
        motion = random_motion(rng)
        paper, ours = (call(load_function(each), *motion) for each in (paper_cell, cell))
        R = rotation(motion[0][3:])
        shifts = paper["shift_vector"].reshape(2, 3) @ R
        local = [
            shift @ contact.T_box_pad[:3, :2]
            for shift, contact in zip(shifts, cell.contacts, strict=True)
        ]
        if (np.abs(local) <= [half_x, half_y]).all():
            kept += 1
            for name, value in paper.items():
                np.testing.assert_array_equal(ours[name], value, err_msg=name)
        else:
            pressed += 1
            efforts = [float(np.sum(each["contact_force"] ** 2)) for each in (paper, ours)]
            assert efforts[1] >= efforts[0]
    assert min(kept, pressed) >= 2


def test_agrees_with_the_true_bodys_balance() -> None:
    """The body's inertia about its own centre of mass follows by Steiner's theorem."""
    rng = np.random.default_rng(11)
    for _ in range(40):
        cell, (pose, rate, second) = random_cell(rng), random_motion(rng)
        payload, R = cell.payload, rotation(pose[3:])
        friction, radius = rng.uniform(0.3, 1.2, 2), rng.uniform(0.005, 0.04, 2)
        mass, disturbance = payload.mass * rng.uniform(0.8, 1.2), rng.normal(size=3)
        centre = payload.centre_of_mass + rng.normal(scale=0.01, size=3)
        displaced = rng.normal(scale=0.002, size=(2, 2))
        d = centre - payload.centre_of_mass
        nominal = mass / payload.mass * payload.inertia
        inertia = R @ (nominal - mass * (d @ d * np.eye(3) - np.outer(d, d))) @ R.T
        omega, alpha = angular_rates(pose[3:], rate[3:], second[3:])
        c = R @ centre
        acceleration = second[:3] + np.cross(alpha, c) + np.cross(omega, np.cross(omega, c))
        force = mass * (acceleration + disturbance - GRAVITY)
        moment = inertia @ alpha + np.cross(omega, inertia @ omega)
        R_box_pad = cell.contacts[0].T_box_pad[:3, :3]
        points = np.array([contact.T_box_pad[:3, 3] for contact in cell.contacts])
        arms = (points - centre) @ R_box_pad
        arms[:, :2] += displaced
        to_pad = (R @ R_box_pad).T
        expected = joint_wrenches(
            Case(to_pad @ force, to_pad @ moment, arms, friction, radius), squeeze=True
        )
        case = np.concatenate([friction, radius, [mass], centre, disturbance, displaced.ravel()])
        case = np.append(case, np.zeros(CASE_SIZE - len(case)))  # pads press as commanded
        found = call(case_squeeze_function(cell), pose, rate, second, case)["normal_force"]
        size = float(np.abs(expected[:, 2]).max())
        assert found == pytest.approx(expected[:, 2] * [1.0, -1.0], abs=1e-6 * size)
