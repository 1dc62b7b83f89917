"""Which pairs of bodies are judged, and how far points move: against Coal and sampled motion."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import trimesh

from hybrid_opt.extras.proposing.problem import read_problem
from symbolic.array import Array
from symbolic.errors import CollisionModelError
from symbolic.geometry.bodies import MeshReader, _link_pieces, collision_bodies
from symbolic.geometry.pairs import CellGeometry, _sorted, build_geometry, pair_tolerance
from symbolic.geometry.pieces import Hull, Piece, ball, farthest_from_axis, skeleton, support
from symbolic.geometry.screen import reach_about_joints
from symbolic.geometry.separation import _gap, coal_distance
from symbolic.read.cell import load
from symbolic.records import (
    Body,
    Box,
    Capsule,
    CollisionSettings,
    Cylinder,
    IgnoredPair,
    Mesh,
    Sphere,
)
from symbolic.records.content import CacheKey
from tests.refusals import refused
from tests.symbolic.cells import ROOT
from tests.symbolic.geometry.collision_cells import (
    functions_of,
    geometry_of,
    placed_pieces,
    rack,
    random_configurations,
    whole_geometry_of,
)
from tests.symbolic.read.samples import RACK
from tests.torso import Torso

pytestmark = pytest.mark.filterwarnings("ignore::symbolic.geometry.hulls.CollisionModelWarning")


def directions(n: int) -> Array:
    u = np.random.default_rng(5).normal(size=(n, 3))
    return np.asarray(u / np.linalg.norm(u, axis=1, keepdims=True))


@pytest.mark.parametrize(
    "shape", [Box(np.array([0.3, 0.5, 0.2])), Cylinder(0.2, 0.5), Capsule(0.1, 0.4), Sphere(0.3)]
)
def test_distances_of_balls_are_those_of_coal(shape: Box | Cylinder | Capsule | Sphere) -> None:
    rng = np.random.default_rng(2)
    for turn, place, centre in rng.normal(size=(200, 3, 3)):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = pin.exp3(turn), place
        zone, piece = ball(centre, rng.uniform(0.05, 0.5)), Piece(shape, T)
        found, expected = _gap(zone, (piece,)), coal_distance((zone,), (piece,))
        assert max(found, 0.0) == pytest.approx(max(expected, 0.0), abs=1e-9)


@pytest.mark.parametrize("name", ["rack", "ur10"])
def test_links_stand_where_pinocchio_puts_them(name: str) -> None:
    """Support of every link in the world against Pinocchio's geometry model."""
    geometry = geometry_of(name)
    robot = geometry.workcell.robots[0]
    model = pin.buildModelFromUrdf(str(robot.urdf))
    shapes = pin.buildGeomFromUrdf(
        model,
        str(robot.urdf),
        pin.GeometryType.COLLISION,
        package_dirs=[str(folder) for folder in robot.package_dirs],
    )
    data, shape_data = model.createData(), shapes.createData()
    q = np.array([0.3, -0.4, 0.5, -0.6, 0.7, -0.8])
    pin.updateGeometryPlacements(model, data, shapes, shape_data, q)
    pieces = placed_pieces(geometry, np.zeros(6), q, q)
    found = {body.name: placed for body, placed in zip(geometry.bodies, pieces, strict=True)}
    u = directions(60)
    expected: dict[str, Array] = {}
    for item, placed in zip(shapes.geometryObjects, shape_data.oMg, strict=True):
        name_of_link = f"{robot.name}/{model.frames[item.parentFrame].name}"
        T = robot.T_world_base @ placed.homogeneous
        value = _support(item, T, u)
        expected[name_of_link] = np.fmax(expected.get(name_of_link, value), value)
    assert len(expected) == {"rack": 7, "ur10": 8}[name]
    for link, value in expected.items():
        own = np.max([support(piece, u) for piece in found[link]], axis=0)
        assert own == pytest.approx(value, abs=2e-6), link


def _support(item: pin.GeometryObject, T: Array, u: Array) -> Array:
    shape = item.geometry
    if hasattr(shape, "halfSide"):
        piece = Piece(Box(2.0 * shape.halfSide), T)
    elif hasattr(shape, "halfLength"):
        piece = Piece(Cylinder(shape.radius, 2.0 * shape.halfLength), T)
    else:
        vertices = np.asarray(shape.vertices())
        piece = Piece(Hull(vertices, np.zeros((0, 3), dtype=np.int64)), T)
    return support(piece, u)


@pytest.mark.parametrize("name", ["rack", "obstacles", "ur10"])
def test_pairs_out_of_reach_never_meet(name: str, tmp_path_factory: pytest.TempPathFactory) -> None:
    geometry = geometry_of(name, tmp_path_factory.getbasetemp() / name)
    proven = [p for p in geometry.excluded if p.reason.startswith(("out of reach", "never meet"))]
    assert proven
    configurations = random_configurations(geometry, 150, np.random.default_rng(6))
    arm_only = [
        pair
        for pair in proven
        if "payload" not in (geometry.bodies[pair.first].name, geometry.bodies[pair.second].name)
    ]
    for pose, q_1, q_2 in zip(*configurations, strict=True):
        pieces = placed_pieces(geometry, pose, q_1, q_2)
        for pair in arm_only:
            assert coal_distance(pieces[pair.first], pieces[pair.second]) > 0.0, pair


def test_pairs_that_count_as_touching_do() -> None:
    geometry = geometry_of("ur10")
    always = [pair for pair in geometry.excluded if pair.reason.startswith("touch in all")]
    configurations = random_configurations(geometry, 50, np.random.default_rng(7))
    for pose, q_1, q_2 in zip(*configurations, strict=True):
        pieces = placed_pieces(geometry, pose, q_1, q_2)
        for pair in always:
            assert coal_distance(pieces[pair.first], pieces[pair.second]) <= 0.0, pair


def reason(geometry: CellGeometry, first: str, second: str) -> str:
    pair = {geometry.index(first), geometry.index(second)}
    return next((p.reason for p in geometry.excluded if {p.first, p.second} == pair), "")


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    [
        ("left/link_2", "left/link_3", "neighbours"),
        ("left/pad", "payload", "grasp"),
        ("left/link_6", "payload", "200.0 mm"),
        ("left/base_link", "ground", "still"),
        ("middle board", "ground", "580.0 mm"),
        ("left/link_1", "right/link_1", "reach"),
        ("left/link_4", "left/link_6", "never"),
        ("left/link_6", "left/pad", "one body"),
        ("left/link_4", "middle board", ""),
        ("left/pad", "right/pad", ""),
        ("payload", "middle board", ""),
        ("left/link_4", "payload", ""),
    ],
)
def test_reasons_of_the_rack(first: str, second: str, expected: str) -> None:
    found = reason(geometry_of("rack"), first, second)
    assert expected in found
    assert bool(found) == bool(expected)


@pytest.mark.parametrize("joints", [1, 2, 3])
@pytest.mark.parametrize("held", [False, True])
def test_links_on_either_side_of_any_joint_are_neighbours(
    joints: int, held: bool, tmp_path: Path
) -> None:
    """Every link with the next one above it that has a shape, the pillar that stands included."""
    torso = Torso(axes=("0 0 1", "0 1 0", "1 0 0")[:joints])
    locked = {"locked_joints": {f"torso_joint_{k}": 0.0 for k in range(joints)}} if held else {}
    geometry = build_geometry(read_problem(torso.problem(tmp_path, robots=[locked] * 2)).workcell())
    found = {
        frozenset(geometry.bodies[k].name.split("/")[1] for k in (pair.first, pair.second))
        for pair in geometry.excluded
        if "overlap" in pair.reason
    }
    above = {"chest": "torso_1" if joints > 2 else "torso_0" if joints > 1 else "pillar"}
    above |= {"torso_1": "torso_0", "torso_0": "pillar"}
    above = {} if held else {k: v for k, v in above.items() if k == "chest" or int(k[-1]) < joints}
    above.pop(f"torso_{joints - 1}", None)
    for side in ("left", "right"):
        above |= {f"{side}_1": "chest", f"{side}_3": f"{side}_1", f"{side}_5": f"{side}_3"}
    assert found == {frozenset(pair) for pair in above.items()}


def test_the_user_may_leave_out_pairs_with_a_reason() -> None:
    """A pattern stands for every pair that it matches."""
    ignored = (
        IgnoredPair("payload", "ground", "low"),
        IgnoredPair("left/link_*", "payload", "held"),
    )
    geometry = build_geometry(replace(rack(), collision=CollisionSettings(ignored=ignored)))
    assert reason(geometry, "payload", "ground").endswith(": low")
    for k in range(1, 7):
        assert reason(geometry, f"left/link_{k}", "payload").endswith(": held")
    assert "ignored" not in reason(geometry, "right/link_1", "payload")
    wrong = CollisionSettings(ignored=(IgnoredPair("payload", "celing", ""),))
    with refused(CollisionModelError, "unknown-body", "'celing'", "ground"):
        build_geometry(replace(rack(), collision=wrong))


def test_bodies_need_different_names_and_a_size() -> None:
    cell = rack()
    twin = replace(cell, environment=(*cell.environment, cell.environment[0]))
    with refused(CollisionModelError, "same-name", "bottom board"):
        collision_bodies(twin)
    dot = Body("dot", Sphere(0.0), np.eye(4))
    with refused(CollisionModelError, "extent", "'dot'", "radius"):
        collision_bodies(replace(cell, environment=(dot,)))


JOINT = '<joint name="j" type="fixed"><parent link="a"/><child link="bare"/></joint>'
URDF = """<robot name="x"><link name="a">{link}</link>{rest}</robot>"""


def test_a_mesh_that_is_nowhere_is_named(tmp_path: Path) -> None:
    path = tmp_path / "x.urdf"
    mesh = '<mesh filename="package://no/where.stl"/>'
    path.write_text(
        URDF.format(link=f"<collision><geometry>{mesh}</geometry></collision>", rest="")
    )
    with refused(CollisionModelError, "mesh-not-found", "'a'", "x.urdf", "package://no/where.stl"):
        _link_pieces(replace(rack().robots[0], urdf=path), ("a", "bare"), MeshReader())


def test_capsules_and_origins_are_read(tmp_path: Path) -> None:
    path = tmp_path / "x.urdf"
    shape = (
        '<collision><origin xyz="1 2 3" rpy="0 0 1.5707963267948966"/>'
        '<geometry><capsule radius="0.1" length="0.4"/></geometry></collision>'
    )
    path.write_text(URDF.format(link=shape, rest='<link name="bare"/>' + JOINT))
    links = _link_pieces(replace(rack().robots[0], urdf=path), ("a", "bare"), MeshReader())
    (piece,) = links["a"]
    assert piece.shape == Capsule(0.1, 0.4)
    assert piece.centre == pytest.approx([1, 2, 3])
    assert piece.rotation @ [1, 0, 0] == pytest.approx([0, 1, 0])
    assert list(links) == ["a"]


def test_meshes_are_read_once_and_within_limits_together(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "ball.stl"
    trimesh.creation.icosphere(subdivisions=3, radius=0.1).export(path)
    ball = Body("ball", Mesh(path, np.ones(3)), np.eye(4))
    twice = replace(rack(), environment=(ball, replace(ball, name="other")))
    first, second = collision_bodies(twice)[-2:]
    assert first.pieces[0].shape is second.pieces[0].shape
    monkeypatch.setattr("symbolic.geometry.bodies.MOST_CORNERS", 1000)
    with refused(CollisionModelError, "too-many-corners", 1284, 642, "'ball'"):
        collision_bodies(twice)
    monkeypatch.setattr("symbolic.read.meshes.MOST_CELL_FACES", 2000)
    larger = replace(ball, name="larger", shape=Mesh(path, 2.0 * np.ones(3)))
    with refused(CollisionModelError, "too-many-triangles", "ball.stl", 1280, 2560):
        collision_bodies(replace(twice, environment=(*twice.environment, larger)))


def test_more_pieces_than_allowed_are_told() -> None:
    few = replace(rack(), collision=CollisionSettings(most_pieces=20))
    with refused(CollisionModelError, "too-many-pieces", 20, "collision.most_pieces"):
        collision_bodies(few)


def test_a_tool_that_enters_the_payload_is_told_by_name() -> None:
    cell = load(RACK)
    left = cell.robots[0]
    part = left.tool[0]
    assert isinstance(part.shape, Cylinder)
    longer = replace(part, shape=replace(part.shape, length=part.shape.length + 0.01))
    with refused(CollisionModelError, "tool-in-payload", "'left/pad'"):
        build_geometry(replace(cell, robots=(replace(left, tool=(longer,)), cell.robots[1])))


def test_pairs_within_an_arm_are_sorted_as_where_it_stands() -> None:
    geometry = build_geometry(load(ROOT / "studies" / "workcells" / "rack.toml"))
    bodies, arms = geometry.bodies, geometry.arms
    left_out = {(pair.first, pair.second) for pair in geometry.excluded}
    possible = {(pair.first, pair.second) for pair in geometry.possible}
    for i, j in combinations(range(len(bodies)), 2):
        tolerance = pair_tolerance(geometry.workcell, bodies[i], bodies[j])
        given = bodies[i], bodies[j], arms, tolerance, bodies
        found = _sorted(CacheKey(*given, known=(i, j)))
        assert bool(found.reason) is ((i, j) in left_out)
        assert found.possible is ((i, j) in possible)


def test_disabled_pairs_of_an_srdf_are_left_out_for_its_robot(tmp_path: Path) -> None:
    cell = rack()
    free = build_geometry(cell)
    pair = ("left/link_1", "left/link_4")
    assert pair in free.pair_names
    srdf = tmp_path / "arm.srdf"
    srdf.write_text(
        '<robot><disable_collisions link1="link_4" link2="link_1" reason="Never"/>'
        '<disable_collisions link1="link_1" link2="no_shape" reason="Never"/></robot>',
        encoding="utf-8",
    )
    robots = (replace(cell.robots[0], srdf=srdf), cell.robots[1])
    geometry = build_geometry(replace(cell, robots=robots))
    assert set(free.pair_names) - set(geometry.pair_names) == {pair}
    assert reason(geometry, *pair).endswith("arm.srdf: Never")


STEPS = 16


def motions(count: int, size: float, seed: int) -> Iterator[tuple[Array, Array, Array, Array]]:
    """Random configurations (18,) of the rack before and after a move, its chord and its bend."""
    geometry = whole_geometry_of("rack")
    motion = functions_of(geometry)["motion"]
    rng = np.random.default_rng(seed)
    starts = np.hstack(random_configurations(geometry, count, rng))
    for a, b in zip(starts, starts + rng.uniform(-size, size, starts.shape), strict=True):
        chord, bend = motion(*np.split(a, 3), *np.split(b, 3))
        yield a, b, np.ravel(np.array(chord)), np.ravel(np.array(bend))


def points_of(pieces: list[tuple[Piece, ...]]) -> list[Array]:
    return [np.vstack([skeleton(piece)[0] for piece in body]) for body in pieces]


@pytest.mark.parametrize("size", [0.02, 0.6])
def test_no_point_moves_farther_than_the_bound(size: float) -> None:
    """Distances at both ends, chord and bend bound every point's way between."""
    geometry = whole_geometry_of("rack")
    for a, b, chord, bend in motions(12, size, 21):
        seen = []
        for s in np.linspace(0.0, 1.0, STEPS + 1):
            c = (1 - s) * a + s * b
            seen.append(points_of(placed_pieces(geometry, *np.split(c, 3))))
        for k, pair in enumerate(geometry.active):
            first, second = geometry.bodies[pair.first], geometry.bodies[pair.second]
            if first.group == second.group:
                continue
            for j, s in enumerate(np.linspace(0.0, 1.0, STEPS + 1)):
                for end, share in ((0, s), (STEPS, 1 - s)):
                    way = sum(
                        np.linalg.norm(seen[j][i] - seen[end][i], axis=1).max()
                        for i in (pair.first, pair.second)
                    )
                    allowed = share * chord[k] + s * (1 - s) / 2.0 * bend[k]
                    assert way <= allowed + 1e-9, geometry.pair_names[k]


def test_links_of_one_arm_approach_no_faster_than_the_bound() -> None:
    geometry = whole_geometry_of("rack")
    own = [
        k
        for k, pair in enumerate(geometry.active)
        if geometry.bodies[pair.first].group == geometry.bodies[pair.second].group
    ]
    assert own
    for a, b, chord, bend in motions(15, 0.2, 22):
        before, after = (placed_pieces(geometry, *np.split(at, 3)) for at in (a, b))
        for k in own:
            pair = geometry.active[k]
            d_a = max(0.0, coal_distance(before[pair.first], before[pair.second]))
            d_b = max(0.0, coal_distance(after[pair.first], after[pair.second]))
            assert bend[k] == 0.0
            assert abs(d_a - d_b) <= chord[k] + 1e-5


def test_reach_of_a_link_about_its_own_joint_is_exact_to_its_shape() -> None:
    geometry = whole_geometry_of("rack")
    arm = geometry.arms[0]
    for body in geometry.bodies:
        if body.group != "robot 1" or body.frame.joint < 0:
            continue
        reach = reach_about_joints(body, arm)
        k = body.frame.joint
        own = max(farthest_from_axis(p, np.zeros(3), arm.axes[k]) for p in body.pieces)
        assert reach[k] == pytest.approx(own)
        assert np.all(reach[k + 1 :] == 0.0)
        assert np.all(reach[:k] > 0.0)
