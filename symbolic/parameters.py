"""A cell's parameters as inputs, so that compiled code depends on the topology only.

`CellParameters` divides the content of a cell into parameters, which compiled functions take as
vectors, and topology, whose digests are the keys of compiled code. Everything that is not named
here as a parameter is topology, including values that remain in formulas: a digest is right
without a list of them. The dynamics of an arm come from its description and are topology; so are
the meshes, and the poses on a link of bodies of several pieces.

A vector is a group of parameters that functions share: those of the task, of either arm, of the
payload and contacts, of both start postures, of the bodies, and of grasps by pads with any normals
under either robot's commanded force. Its entries are named by the key paths of the workcell file;
entries that NumPy derives from several keys have names of their own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cache, cached_property, lru_cache, partial
from math import prod
from pathlib import Path
from types import MappingProxyType
from typing import Any

import casadi as ca
import numpy as np

from symbolic.array import Array
from symbolic.cell_model import CellBodies, CellModel
from symbolic.contact.force_closure import dependent_components, grasp_shapes
from symbolic.contact.registry import command_model, contact_model
from symbolic.contact.soft_finger import SoftPatch
from symbolic.geometry.screen import Screen, ScreenBase, ScreenBody
from symbolic.records import Contact, RedundantJoint, Robot, Task, Waypoint, Workcell
from symbolic.records.cell import box_flange, flange_lever
from symbolic.records.content import CacheKey, digest_of_parts
from symbolic.records.numbered import (
    GraspNumbers,
    NumberedContact,
    NumberedJoint,
    NumberedPayload,
    NumberedRobot,
    NumberedTask,
    NumberedWaypoint,
    NumberedWorkcell,
    ParameterGroup,
)
from symbolic.robot.model import RobotModel

TASK, HELD, START, BODIES = "task_numbers", "held_numbers", "start_numbers", "body_numbers"
ARM_GROUPS = ("arm_1_numbers", "arm_2_numbers")
SQUEEZES = ("squeeze_1_numbers", "squeeze_2_numbers")
GROUPS = frozenset((TASK, HELD, START, BODIES, *ARM_GROUPS, *SQUEEZES))
"""Names of all groups of parameters; functions take the groups as their last inputs."""


@dataclass(frozen=True)
class Parameter:
    """Placeholder of a parameter array in a cell's topology: its name and shape, without values.

    Attributes:
        group: name of the parameter group.
        key: key path in the workcell file, or a description.
        shape: shape of the array, () for a single number.
    """

    group: str
    key: str
    shape: tuple[int, ...]


@dataclass(frozen=True)
class LazyParameter:
    """Parameter array whose values are computed on first use.

    Attributes:
        shape: shape of the array.
        find: function without arguments that returns the values.
    """

    shape: tuple[int, ...]
    find: Callable[[], Array]


class _Collector:
    """Replacer of a cell's parameters by placeholders; it collects the values.

    Each parameter becomes a `Parameter`, its placeholder in the topology.
    """

    def __init__(self) -> None:
        self.entries: dict[str, list[tuple[Parameter, Array | LazyParameter]]] = {}

    def __call__(self, group: str, key: str, value: Any) -> Any:
        array = value if isinstance(value, LazyParameter) else np.asarray(value, dtype=float)
        entry = Parameter(group, key, array.shape)
        self.entries.setdefault(group, []).append((entry, array))
        return entry

    def pose(self, rotation: Any, position: Any) -> Any:
        return ("pose", rotation, position)

    def upright(self, cosine: Any, sine: Any) -> Any:
        return ("turn about z", cosine, sine)

    def group(self, name: str) -> ParameterGroup:
        return ParameterGroup(name, ())

    def body(self, path: str, body: ScreenBody) -> Any:
        taken, entries = _collected_body(CacheKey(path, body, known=(path, body.content)))
        self.entries.setdefault(BODIES, []).extend(entries)
        return taken


class _Symbols:
    """Replacer of a cell's parameters by symbols.

    The symbols of a parameter are a slice of the vector of its group. Parameters must come in the
    order in which `_Collector` took them.
    """

    def __init__(self, sizes: Mapping[str, int]) -> None:
        self._groups = {
            name: ParameterGroup(name, ca.SX.sym(name, size)) for name, size in sizes.items()
        }
        self._taken = dict.fromkeys(sizes, 0)

    def __call__(self, group: str, key: str, value: Any) -> Any:
        shape = value.shape if isinstance(value, LazyParameter) else np.shape(value)
        at, size = self._taken[group], prod(shape)
        self._taken[group] = at + size
        found = self._groups[group].symbols[at : at + size]
        return ca.reshape(found, *shape[::-1]).T if len(shape) == 2 else found

    def pose(self, rotation: Any, position: Any) -> Any:
        return ca.vertcat(ca.horzcat(rotation, position), ca.DM([[0, 0, 0, 1]]))

    def upright(self, cosine: Any, sine: Any) -> Any:
        return ca.vertcat(
            ca.horzcat(cosine, -sine, 0), ca.horzcat(sine, cosine, 0), ca.DM([[0, 0, 1]])
        )

    def group(self, name: str) -> ParameterGroup:
        return self._groups[name]

    def body(self, path: str, body: ScreenBody) -> Any:
        return _body(self, path, body)


_Take = _Collector | _Symbols


@dataclass(frozen=True)
class WorkcellParameters:
    """Division of a cell, without its collision bodies, into parameters and topology.

    Parameters are values that compiled functions take as inputs; topology is everything else.

    Attributes:
        cell: description of the cell.
    """

    cell: Workcell

    @cached_property
    def _collected(self) -> tuple[_Collector, NumberedWorkcell]:
        take = _Collector()
        return take, _workcell(take, self.cell)

    @property
    def workcell(self) -> NumberedWorkcell:
        """Topology of the cell: its description, with a `Parameter` in place of every
        parameter's value."""
        return self._collected[1]

    @property
    def _entries(self) -> dict[str, list[tuple[Parameter, Array | LazyParameter]]]:
        return self._collected[0].entries

    @property
    def layout(self) -> dict[str, tuple[Parameter, ...]]:
        """Parameters of each group in the order of the group's vector, by the group's name. The
        groups of the start postures are left out."""
        return {name: tuple(each for each, _ in found) for name, found in self._entries.items()}

    @cached_property
    def sizes(self) -> dict[str, int]:
        """Number of entries of each parameter group's vector, by the group's name. The groups of
        the start postures are left out."""
        return {
            name: sum(prod(each.shape) for each in found) for name, found in self.layout.items()
        }

    def vector(self, name: str) -> Array:
        """Return the values (n,) of all parameters of the group `name`, one after the other.

        Raises:
            SettingsError: the group describes a grasp whose pads cannot close it.
        """
        if name not in self._vectors:
            parts = [
                v.find() if isinstance(v, LazyParameter) else v for _, v in self._entries[name]
            ]
            self._vectors[name] = np.concatenate([np.ravel(part) for part in parts])
        return self._vectors[name]

    @cached_property
    def _vectors(self) -> dict[str, Array]:
        return {}

    @cached_property
    def workcell_digest(self) -> str:
        """Digest (SHA-256) of the topology without arms and collision bodies."""
        return digest_of_parts((self._collected[1],))

    def symbols(self) -> NumberedWorkcell:
        """Return the cell's description with CasADi symbols in place of all parameters."""
        return _workcell(self._symbols(), self.cell)

    def _symbols(self, further: Mapping[str, int] = MappingProxyType({})) -> _Symbols:
        return _Symbols(self.sizes | dict(further))


@dataclass(frozen=True)
class CellParameters(WorkcellParameters):
    """Division of a cell with its collision bodies into parameters and topology.

    Attributes:
        bounds: parameters of the formulas for lower bounds of all pairs' distances.
        models: models of both arms.
    """

    bounds: Screen
    models: tuple[RobotModel, RobotModel]

    @cached_property
    def _of_bodies(self) -> tuple[_Collector, Screen]:
        take = _Collector()
        return take, _screen(take, self.bounds)

    @property
    def screen(self) -> Screen:
        """Topology of the distance bounds, with a `Parameter` in place of every parameter's
        value."""
        return self._of_bodies[1]

    @property
    def _entries(self) -> dict[str, list[tuple[Parameter, Array | LazyParameter]]]:
        return super()._entries | self._of_bodies[0].entries

    @cached_property
    def digest(self) -> str:
        """Digest (SHA-256) of the topology of workcell and arms, without collision bodies."""
        arms = tuple(
            (model.model.saveToString(), model.flange_id, model.redundant, model.pose_size)
            for model in self.models
        )
        return digest_of_parts((self.workcell_digest, arms))

    @cached_property
    def bodies_digest(self) -> str:
        """Digest (SHA-256) of the topology of the whole cell, collision bodies included."""
        return digest_of_parts((self.digest, self.screen))

    def symbolic(self, bodies: CellBodies) -> CellModel:
        """Build the model of the cell with CasADi symbols in place of all parameters. Functions
        of this model take the parameters as inputs.

        Args:
            bodies: arms and bodies of this cell, or of a cell with the same topology.
        """
        joints = [model.n_joints for model in self.models]
        take = self._symbols({START: sum(joints)})
        workcell, screen = _workcell(take, self.cell), _screen(take, self.bounds)
        start = take.group(START)
        first, second = ca.vertsplit(start.symbols, [0, joints[0], sum(joints)])
        robots, geometry = bodies.robots, bodies.geometry
        model = CellModel(workcell, robots, geometry, ((), ()), (first, second), start)
        vars(model)["screen"] = screen
        return model


# --- the cell without its bodies ---


def _workcell(take: _Take, cell: Workcell) -> NumberedWorkcell:
    """Return a cell's description in which `take` has replaced every parameter by a placeholder or
    a symbol.

    Values that no formula uses become constants.
    """
    first = _robot(take, 0, cell.robots[0], cell.contacts[0])
    second = _robot(take, 1, cell.robots[1], cell.contacts[1])
    payload: Any = replace(cell.payload, size=np.zeros(3), shape=None, jerk_max=None)
    task: Any = replace(
        cell.task,
        reference_force=np.ones(2),
        initial=np.zeros(0),
        allowed_contacts=(),
        force_limit=(0.0, 0.0),
    )
    names = ["mass", "centre_of_mass", "inertia", "velocity_max", "acceleration_max"]
    names += ["angular_velocity_max", "angular_acceleration_max"]
    own = {name: take(HELD, f"payload.{name}", getattr(payload, name)) for name in names}
    payload = _as(NumberedPayload, payload, **own, given=take.group(HELD))
    derived = iter(contact_model(cell).pad_parameters)
    contacts: Any = tuple(
        _contact(take, f"contacts[{i}]", contact, cell, derived)
        for i, contact in enumerate(cell.contacts)
    )
    return NumberedWorkcell(
        name="",
        robots=(first, second),
        payload=payload,
        contacts=contacts,
        task=_task(take, task),
        environment=(),
        facing=cell.has_facing_pads,
        opposite=cell.has_opposite_pads,
        beside=cell.has_offset_pads,
        grasp=None
        if contact_model(cell).has_closed_form
        else _grasp(take, HELD, "grasp", cell, None),
        squeezes=()
        if command_model(cell).has_scalar_squeeze
        else tuple(_grasp(take, name, name, cell, i) for i, name in enumerate(SQUEEZES)),
    )


def _grasp(
    take: _Take, group: str, path: str, cell: Workcell, commanded: int | None
) -> GraspNumbers:
    """Return the record of a grasp by pads with any normals in which `take` has replaced every
    array of constants: by a placeholder (`Parameter`) or by symbols.

    `take` gets the array's shape at once. The arrays' values, which cost a search for the internal
    squeeze, are computed when the vector of the group is first asked for.

    Args:
        take: replaces an array by a placeholder or by symbols.
        group: name of the parameter group.
        path: first part of the parameters' key paths.
        cell: description of the cell, from which the constants follow.
        commanded: index of the robot whose commanded force the grasp serves (`GraspSqueeze`); None
            for the grasp of planned forces (`Grasp`).
    """

    @cache
    def found() -> GraspNumbers:
        # Not imported at the top: few cells have such pads.
        from symbolic.contact.grasp import Grasp
        from symbolic.contact.grasp_squeeze import GraspSqueeze

        made = Grasp(cell) if commanded is None else GraspSqueeze(cell, commanded)
        return made.complete()

    def shape_of(pad: int) -> Array:
        return np.asarray(found().shapes[pad])

    def taken(name: str, shape: Any) -> Any:
        if name == "shapes":
            pads = (LazyParameter(each, partial(shape_of, k)) for k, each in enumerate(shape))
            return tuple(take(group, f"{path}.shapes[{k}]", pad) for k, pad in enumerate(pads))
        return take(group, f"{path}.{name}", LazyParameter(shape, lambda: getattr(found(), name)))

    shapes = grasp_shapes(cell)
    numbers = {name: taken(name, shape) for name, shape in shapes.items()}
    return GraspNumbers(left=dependent_components(cell), **numbers, given=take.group(group))


def _as(kind: Any, record: Any, **changes: Any) -> Any:
    """Convert a record to a class with the same fields and perhaps further ones.

    Args:
        kind: the new class.
        record: record from which the fields' values are taken.
        changes: values of fields that differ from the record's, or that the record lacks.
    """
    known = {each.name: getattr(record, each.name) for each in fields(record)}
    return kind(**(known | changes))


def _robot(take: _Take, i: int, robot: Robot, contact: Contact) -> NumberedRobot:
    group, path = ARM_GROUPS[i], f"robots[{i}]"
    T_box_flange = box_flange(robot, contact)
    names = ["position_lower", "position_upper", "velocity_max", "acceleration_max"]
    names += ["torque_max", "min_manipulability"]
    own = {name: take(group, f"{path}.{name}", getattr(robot, name)) for name in names}
    base = robot.T_world_base
    flange = (take(group, f"{path} in the box", part) for part in _split(T_box_flange))
    return NumberedRobot(
        name="",
        urdf=Path(),
        package_dirs=(),
        flange="",
        locked_joints=(),
        T_world_base=take.pose(
            _turn(take, group, path, base[:3, :3]), take(group, f"{path}.base.xyz", base[:3, 3])
        ),
        T_flange_pad=np.zeros((4, 4)),
        tool=(),
        T_box_flange=take.pose(*flange),
        lever=take(group, f"{path} lever", flange_lever(robot, contact)),
        given=take.group(group),
        **own,
    )


def _split(T: Array) -> tuple[Array, Array]:
    return T[:3, :3], T[:3, 3]


def _turn(take: _Take, group: str, path: str, rotation: Array) -> Any:
    """Return the rotation of a robot's base with its numbers replaced by placeholders or symbols.

    For an upright base the replaced numbers are cosine and sine of its angle about z. For a tilted
    base they are all entries of the matrix.

    Args:
        take: replaces a parameter by a placeholder or a symbol.
        group: name of the parameter group.
        path: key path of the robot.
        rotation: (3, 3) rotation of the base in the world.
    """
    level = np.array([0.0, 0.0, 1.0])
    if np.array_equal(rotation[2], level) and np.array_equal(rotation[:, 2], level):
        cosine, sine = rotation[0, 0], rotation[1, 0]
        key = f"{path}.base.rpy"
        return take.upright(
            take(group, f"{key}, cosine", cosine), take(group, f"{key}, sine", sine)
        )
    return take(group, f"{path}.base.rpy", rotation)


def _contact(
    take: _Take,
    path: str,
    contact: Contact,
    cell: Workcell,
    derived: Iterator[dict[str, Any]],
) -> Any:
    own = next(derived)
    pose = (take(HELD, f"{path} pose", part) for part in _split(contact.T_box_pad))
    patch = SoftPatch.of(contact, cell.contacts[0].T_box_pad[:3, :3])
    sides = contact.half_sides
    return _as(
        NumberedContact,
        contact,
        T_box_pad=take.pose(*pose),
        friction=take(HELD, f"{path}.friction", contact.friction),
        patch_radius=take(HELD, f"{path}.patch_radius", contact.patch_radius),
        half_sides=None
        if sides is None
        else tuple(take(HELD, f"{path}.patch_size[{k}]", side) for k, side in enumerate(sides)),
        further=tuple(
            _contact(take, f"{path}.further[{k}]", pad, cell, derived)
            for k, pad in enumerate(contact.further)
        ),
        twist=take(HELD, f"{path} twist", patch.twist),
        spread=take(HELD, f"{path} spread", patch.spread),
        holding_force=0.0,
        layer_shear=0.0,
        layer_stiffness=0.0,
        **{name: take(HELD, f"{path} {name}", value) for name, value in own.items()},
    )


def _task(take: _Take, task: Task) -> Any:
    names = ("reference_speed", "reference_angular_speed", "ramp_time")
    return _as(
        NumberedTask,
        task,
        **{name: take(TASK, f"task.{name}", getattr(task, name)) for name in names},
        waypoints=tuple(_waypoint(take, k, point) for k, point in enumerate(task.waypoints)),
        redundant=tuple(_joint(take, joint) for joint in task.redundant),
        given=take.group(TASK),
    )


def _waypoint(take: _Take, k: int, point: Waypoint) -> NumberedWaypoint:
    if not point.is_fixed:
        return NumberedWaypoint(np.zeros(0), np.zeros(0))
    pose = take(TASK, f"task pose {k}", point.lower)
    return NumberedWaypoint(pose, pose, fixed=True)


def _joint(take: _Take, joint: RedundantJoint) -> NumberedJoint:
    lower: Any = tuple(
        0.0 if moves else take(TASK, f"{joint.name} at pose {k}", low)
        for k, (moves, low) in enumerate(zip(joint.moving.tolist(), joint.lower, strict=True))
    )
    free, none = tuple(joint.moving.tolist()), np.zeros(0)
    return NumberedJoint("", joint.drives, lower, none, none, free)


# --- its bodies ---


def _screen(take: _Take, screen: Screen) -> Screen:
    """Return the constants of the distance bounds in which `take` has replaced every parameter by a
    placeholder or a symbol.

    Shapes of links and of meshes remain unchanged, as part of the topology.
    """
    first, second = (_base(take, f"robots[{i}]", base) for i, base in enumerate(screen.bases))
    return replace(
        screen,
        bases=(first, second),
        bodies=tuple(take.body(f"body {k}", body) for k, body in enumerate(screen.bodies)),
        payload=screen.payload
        if screen.payload_is_mesh
        else _own(take, "payload box", screen.payload),
        between=_own(take, "between bases", screen.between),
        given=take.group(BODIES),
    )


def _base(take: _Take, path: str, base: ScreenBase) -> ScreenBase:
    rotation = _turn(take, BODIES, path, base.rotation)
    return ScreenBase(rotation, take(BODIES, f"{path}.base.xyz", base.position))


@lru_cache(maxsize=512)
def _collected_body(seen: CacheKey) -> tuple[Any, list[tuple[Parameter, Array | LazyParameter]]]:
    """Collect the parameters of one body. The result is cached, because variants of a cell share
    most bodies.

    Args:
        seen: cache key that holds the first part of the parameters' key paths, and the body.

    Returns:
        The body with placeholders for its parameters; and each parameter with its values.
    """
    take, (path, body) = _Collector(), seen.given
    return _body(take, path, body), take.entries.get(BODIES, [])


def _body(take: _Take, path: str, body: ScreenBody) -> Any:
    if not body.is_constant:
        return _own(take, path, body)
    if body.frame.kind != "world" or body.chain is None:
        return body
    chain = replace(body.chain, centres=_own(take, f"{path} chain", body.chain.centres))
    pieces, extent = _own(take, path, body.pieces), _own(take, f"{path} extent", body.extent)
    return replace(body, chain=chain, pieces=pieces, extent=extent)


def _own(take: _Take, path: str, value: Any) -> Any:
    """Return a copy of a body's record in which every array, also in nested records and tuples, is
    replaced by a placeholder or a symbol, in the order of the fields.

    Args:
        take: replaces a parameter by a placeholder or a symbol.
        path: key path of the record.
        value: the record, or a tuple or array in it.
    """
    if isinstance(value, np.ndarray) and value.size:
        return take(BODIES, path, value)
    if isinstance(value, tuple):
        return tuple(_own(take, f"{path}[{k}]", entry) for k, entry in enumerate(value))
    if is_dataclass(value) and not isinstance(value, type):
        own = {each.name: getattr(value, each.name) for each in fields(value)}
        return replace(
            value, **{name: _own(take, f"{path}.{name}", each) for name, each in own.items()}
        )
    return value
