"""The JSON Schema of workcell files, with which editors complete keys and mark wrong values.

Ranges come from `symbolic.records.quantities`, keys and meanings from the records. A schema cannot
describe robots and geometry: it accepts more than `symbolic.read.cell.load`, and never refuses a
file that `load` accepts. Keys that `dual-arm-carry propose` adds to a problem file are not
required.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import MISSING, fields, is_dataclass
from inspect import getdoc
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from symbolic.array import BroadcastScalar, Range, Shape
from symbolic.contact.registry import CONTACT_MODELS
from symbolic.read.payload import MOST_HANDS, PAYLOAD_KINDS
from symbolic.read.robots import LIMIT_KEYS, MAX_START_BRANCH, UNKNOWN_TORQUE
from symbolic.read.tables import SHAPES
from symbolic.read.task import MAX_PIECES, MAX_WAYPOINTS
from symbolic.records import Handling, Payload, Robot, Uncertainty
from symbolic.records import quantities as quantity
from symbolic.records.cell import CollisionSettings, Driver, HandKind, ToolLoad
from symbolic.records.poses import Rotation
from symbolic.records.shapes import Mesh
from symbolic.records.task import AllowedContact, Task
from symbolic.records.time_law import TIME_LAWS

Schema = dict[str, Any]

DRAFT = "https://json-schema.org/draft/2020-12/schema"

TEXT: Schema = {"type": "string", "minLength": 1}


def workcell_schema() -> Schema:
    """Return the schema of a workcell file, as JSON values."""
    body = _body()
    top = {
        "name": _with("title for reports", TEXT),
        "robots": _with("both arms; robot i holds contact i", _array(_robot(body), 2, 2)),
        "payload": _payload(),
        "contacts": _with("where each robot holds the payload", _array(_contact(), 2, 2)),
        "task": _task(),
        "environment": _with("fixed bodies in the world", _array(body)),
        "collision": _table(_fields(CollisionSettings)),
        "uncertainty": _table(_fields(Uncertainty, "stated")),
        "handling": _table(_fields(Handling)),
    }
    required = ("name", "robots", "payload", "contacts", "task")
    return {"$schema": DRAFT, "title": "A dual-arm cell and its task", **_table(top, required)}


# --- sections ---


def _robot(body: Schema) -> Schema:
    pose = _table({"xyz": _vector(quantity.POSITION, 3), "rpy": _vector(quantity.ANGLE, 3)})
    limits = {}
    for key, (_, allowed) in LIMIT_KEYS.items():
        each = _number(allowed)
        # One number stands for all joints, except for an end of a range of positions.
        limits[key] = _array(each) if key.startswith("position") else _any(each, _array(each))
    limits["torque_max"]["anyOf"].append({"const": UNKNOWN_TORQUE})
    branch = _any(
        {"type": "integer", "minimum": -1, "maximum": MAX_START_BRANCH}, {"const": "search"}
    )
    load = _fields(ToolLoad) | {"inertia": _matrix(quantity.INERTIA)}
    keys = {
        "name": TEXT,
        "urdf": TEXT,
        "robot": _with("instead of urdf: a robot by name, as 'ur10e_description'", TEXT),
        "xacro_arguments": {"type": "object", "additionalProperties": TEXT},
        "package_dirs": _array(TEXT),
        "srdf": TEXT,
        "flange": TEXT,
        "chain": _with("instead of flange: the first and the last link", _array(TEXT, 2, 2)),
        "drop_links": _array(TEXT),
        "base": _with("the URDF's root in the world", pose),
        "pad": _with("the pad frame on the flange", pose),
        "locked_joints": {
            "type": "object",
            "additionalProperties": _number(quantity.LOCKED_POSITION),
        },
        **limits,
        "redundant_joints": _array(TEXT),
        "min_manipulability": _number(quantity.MANIPULABILITY),
        "start_branch": _with("among the ranked start postures; -1 leaves it open", branch),
        "tool": _array(body),
        "tool_load": _table(load, ("mass",)),
        "driver": _table(_fields(Driver)),
    }
    return _table(_described(Robot, keys), ("name", "base", "pad"))


def _payload() -> Schema:
    size, inertia = _number(quantity.PAYLOAD_SIZE), _matrix(quantity.INERTIA)
    keys = {
        **_fields(Payload, "shape"),
        "kind": _words(PAYLOAD_KINDS),
        "size": _array(size, 3, 3),
        "radius": size,
        "length": size,
        "path": TEXT,
        "scale": _kind(get_type_hints(Mesh, include_extras=True)["scale"]),
        "inertia": _any({"enum": ["solid", "solid box"]}, inertia),
    }
    return _table(_described(Payload, keys), ("mass",))


def _contact() -> Schema:
    place = {
        "xyz": _with("centre of the patch in the box frame [m]", _vector(quantity.POSITION, 3)),
        "normal": _with("direction into the payload", _vector(quantity.DIRECTION, 3)),
        "spin": _with("turn about the normal [rad]", _number(quantity.ANGLE)),
    }
    further = _array(_table(place, ("xyz",)), 0, MOST_HANDS)
    keys = {
        **place,
        "friction": _with("Coulomb coefficient", _number(quantity.FRICTION)),
        "patch_radius": _with("of a round patch [m]", _number(quantity.PATCH_RADIUS)),
        "patch_size": _with("sides of a rectangular patch [m]", _vector(quantity.PATCH_SIDE, 2)),
        "further": _with("other pads or hands of the same robot", further),
        "kind": _with("a pad, or a hand that holds by itself", _words(get_args(HandKind))),
        "holding_force": _with("of each such hand [N]", _number(quantity.FORCE)),
        "layer_shear": _with("of its layer, along over across", _number(quantity.LAYER)),
        "layer_stiffness": _with("of its layer over that of others", _number(quantity.LAYER)),
    }
    return _table(keys, ("friction",))


def _task() -> Schema:
    pose = _array([_number(each) for each in quantity.POSE])
    waypoint = {
        "fixed": pose,
        "lower": pose,
        "upper": pose,
        "count": {"type": "integer", "minimum": 1, "maximum": MAX_WAYPOINTS},
    }
    along = _number(quantity.LOCKED_POSITION)
    path = _any(along, _array(along))
    redundant = _table({"joint": TEXT, "lower": path, "upper": path, "initial": path}, ("joint",))
    models = _words(tuple(CONTACT_MODELS))
    derived = ("waypoints", "initial", "allocation", "force_limit", "redundant", "orientation")
    keys = {
        **_fields(Task, *derived, "pieces", "time_law"),
        "start": _with("pose of the box: x, y, z, roll, pitch, yaw [m, rad]", pose),
        "goal": _with("likewise, at the end", pose),
        "rotation": _with(
            "meaning of the last three numbers of a pose", _words(get_args(Rotation))
        ),
        "rotation_reference": _with(
            "roll, pitch, yaw that rotation vectors turn [rad]", _vector(quantity.ANGLE, 3)
        ),
        "waypoints": _array(_table(waypoint), 0, MAX_WAYPOINTS),
        "initial": _array(pose),
        "time_law": _words(tuple(TIME_LAWS)),
        "force_limit": _vector(quantity.FORCE, 2),
        "allocation": models,
        "drivable_allocation": _with("likewise under the time law 'optimal'", models),
        "drivable_pieces": _with(
            "pieces of the path between two waypoints, under the time law 'optimal'",
            {"type": "integer", "minimum": 1, "maximum": MAX_PIECES},
        ),
        "redundant": _array(redundant),
        "allowed_contacts": _array(_table(_fields(AllowedContact), ("body", "departure"))),
    }
    return _table(_described(Task, keys), ("start", "goal", "reference_speed"))


def _body() -> Schema:
    keys: dict[str, Schema] = {"name": TEXT, "kind": _words(tuple(SHAPES))}
    keys |= {"xyz": _vector(quantity.POSITION, 3), "rpy": _vector(quantity.ANGLE, 3)}
    for shape in SHAPES.values():
        keys |= _fields(shape, "path")
    return _table(keys | {"path": TEXT}, ("name", "kind"))


# --- records and annotations ---


def _fields(record: type, *without: str) -> dict[str, Schema]:
    """Return the schemas of a record's fields by name, with the meanings from its docstring.

    Args:
        record: class of the record.
        without: names of fields to leave out.
    """
    hints = get_type_hints(record, include_extras=True)
    keys = {field: kind for field, kind in hints.items() if field not in without}
    return _described(record, {key: _kind(kind) for key, kind in keys.items()})


def _kind(kind: Any) -> Schema:
    """Return the JSON schema of a type annotation, one of those that `symbolic.read.tables.checked`
    knows."""
    marks: tuple[Any, ...] = ()
    if get_origin(kind) is Annotated:
        kind, *marks = get_args(kind)  # type: ignore[assignment]
    origin, arguments = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        return _kind(next(choice for choice in arguments if choice is not type(None)))
    allowed = next((mark for mark in marks if isinstance(mark, Range)), None)
    shape = next((mark for mark in marks if isinstance(mark, Shape)), None)
    if shape is not None and allowed is not None:
        filling = any(isinstance(mark, BroadcastScalar) for mark in marks)
        return _vector(allowed, shape.sizes[0] or 0, filling)
    if is_dataclass(kind):
        assert isinstance(kind, type), "annotations name classes"
        return _table(_fields(kind), tuple(f.name for f in fields(kind) if f.default is MISSING))
    if origin is tuple:
        return _array(_kind(arguments[0]))
    if origin is Literal:
        return _words(arguments)
    if kind in (int, float):
        return _number(allowed, "integer" if kind is int else "number")
    return {"type": "boolean"} if kind is bool else {"type": "string"} if kind is str else {}


def _described(record: type, keys: dict[str, Schema]) -> dict[str, Schema]:
    """Return the schemas of a record's fields, with the descriptions from the record's docstring
    added.

    Args:
        record: class of the record; the attributes in its docstring are the descriptions.
        keys: schemas by field.
    """
    text = (getdoc(record) or "").partition("Attributes:\n")[2].partition("\n\n")[0]
    entries = re.findall(r"^ {4}(\w[\w, ]*): (.*(?:\n {8}.*)*)", text, re.MULTILINE)
    meanings = {
        name.strip(): " ".join(meaning.split()).rstrip(".")
        for names, meaning in entries
        for name in names.split(",")
    }
    return {
        key: _with(meanings[key], schema)
        if key in meanings and "description" not in schema
        else schema
        for key, schema in keys.items()
    }


# --- parts ---


def _with(description: str, schema: Schema) -> Schema:
    return {"description": description, **schema}


def _table(keys: dict[str, Schema], required: Sequence[str] = ()) -> Schema:
    found: Schema = {"type": "object", "properties": keys, "additionalProperties": False}
    return found | ({"required": list(required)} if required else {})


def _array(each: Schema | Sequence[Schema], least: int = 0, most: int | None = None) -> Schema:
    """Return the schema of an array.

    Args:
        each: one schema for all entries; or a sequence with one schema per entry, which fixes the
            number of entries.
        least, most: bounds of the number of entries, if `each` is one schema. If `most` is None,
            neither bound applies.
    """
    if not isinstance(each, dict):
        sizes = {"minItems": len(each), "maxItems": len(each)}
        return {"type": "array", "prefixItems": list(each), **sizes}
    sizes = {} if most is None else {"minItems": least, "maxItems": most}
    return {"type": "array", "items": each, **sizes}


def _number(allowed: Range | None, kind: str = "number") -> Schema:
    ends = {} if allowed is None else {"minimum": allowed.low, "maximum": allowed.high}
    return {"type": kind, **{key: end for key, end in ends.items() if math.isfinite(end)}}


def _vector(allowed: Range, size: int, filling: bool = False) -> Schema:
    """Return the schema of an array of numbers.

    Args:
        allowed: range of every number.
        size: number of entries.
        filling: True if one number may stand for all entries.
    """
    numbers = _array(_number(allowed), size, size)
    return _any(_number(allowed), numbers) if filling else numbers


def _matrix(allowed: Range) -> Schema:
    return _array(_vector(allowed, 3), 3, 3)


def _any(*schemas: Schema) -> Schema:
    return {"anyOf": list(schemas)}


def _words(words: Sequence[str]) -> Schema:
    return {"enum": list(words)}
