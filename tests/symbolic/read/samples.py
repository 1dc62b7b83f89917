"""Workcell files to try: one of everything, and random valid ones as plain data."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import studies
from symbolic.read.payload import solid_box_inertia

STUDIES = Path(studies.__file__).parent
RACK = STUDIES / "workcells" / "rack.toml"
SAMPLE = Path(__file__).with_name("sample_cell.toml")
GOFA = STUDIES / "robots" / "gofa12.urdf"


def sample_data() -> dict[str, Any]:
    """A valid cell's content with absolute URDF paths, fresh at each call."""
    data = tomllib.loads(SAMPLE.read_text(encoding="utf-8"))
    for robot in data["robots"]:
        robot["urdf"] = str(GOFA)
    return data


def write(folder: Path, data: dict[str, Any]) -> Path:
    """A TOML file with this content."""
    path = folder / "cell.toml"
    text = "\n".join(f"{_key(key)} = {_value(value)}" for key, value in data.items())
    path.write_text(text + "\n", encoding="utf-8")
    return path


def _key(key: str) -> str:
    return json.dumps(key, ensure_ascii=False)


def _value(value: Any) -> str:
    """An inline TOML value; tables are written inline, which TOML treats alike."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_key(k)} = {_value(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_value(entry) for entry in value) + "]"
    if isinstance(value, bool | str):
        return json.dumps(value, ensure_ascii=False)
    return repr(value)  # numbers; nan and inf are written as in TOML


def numbers(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_subnormal=False)


def vectors(low: float, high: float, count: int = 3) -> st.SearchStrategy[list[float]]:
    return st.lists(numbers(low, high), min_size=count, max_size=count)


SMALL_POSE = st.builds(lambda xyz, rpy: [*xyz, *rpy], vectors(-0.1, 0.1), vectors(-6.2, 6.2))
NAMES = st.text(
    st.characters(exclude_categories=("C", "Z"), exclude_characters="/"), min_size=1, max_size=60
)


@st.composite
def shapes(draw: st.DrawFn) -> dict[str, Any]:
    size = numbers(1e-3, 9.0)
    shape = draw(
        st.one_of(
            st.fixed_dictionaries({"kind": st.just("box"), "size": vectors(1e-3, 9.0)}),
            st.fixed_dictionaries({"kind": st.just("sphere"), "radius": size}),
            st.fixed_dictionaries({"kind": st.just("cylinder"), "radius": size, "length": size}),
        )
    )
    optional = draw(
        st.fixed_dictionaries({}, optional={"xyz": vectors(-9, 9), "rpy": vectors(-6, 6)})
    )
    return {**shape, **optional}


@st.composite
def robots(draw: st.DrawFn, name: str) -> dict[str, Any]:
    tool_names = draw(st.lists(NAMES, max_size=2, unique=True))
    optional = {
        "acceleration_max": st.one_of(numbers(0.1, 50), vectors(0.1, 50, 6)),
        "jerk_max": st.one_of(numbers(1, 9000), vectors(1, 9000, 6)),
        "velocity_max": vectors(0.1, 10, 6),
        "torque_max": vectors(1, 500, 6),
        "position_lower": vectors(-6, -0.1, 6),
        "position_upper": vectors(0.1, 6, 6),
        "min_manipulability": numbers(1e-6, 0.1),
        "start_branch": st.integers(-1, 7),
        "driver": st.fixed_dictionaries(
            {},
            optional={
                "address": st.sampled_from(["arm.local", "192.168.0.1", "fe80::1"]),
                "prefix": st.sampled_from(["", "left_"]),
                "rate": numbers(10.0, 8000.0),
                "lag": numbers(0.0, 0.5),
                "force_control": st.booleans(),
                "stiffness": numbers(1e3, 1e6),
            },
        ),
    }
    return {
        "name": name,
        "urdf": str(GOFA),
        "flange": "tool0",
        "base": {"xyz": draw(vectors(-0.2, 0.2)), "rpy": draw(vectors(-6, 6))},
        "pad": {"xyz": draw(vectors(-0.1, 0.1)), "rpy": draw(vectors(-6, 6))},
        "tool": [{"name": f"tool {tool}", **draw(shapes())} for tool in tool_names],
        **draw(st.fixed_dictionaries({}, optional=optional)),
    }


@st.composite
def payloads(draw: st.DrawFn) -> dict[str, Any]:
    size, mass = np.array(draw(vectors(0.1, 0.5))), draw(numbers(0.1, 100))
    turn = Rotation.from_rotvec(draw(vectors(-3, 3))).as_matrix()
    matrix = turn @ solid_box_inertia(size * draw(numbers(0.5, 0.9)), mass) @ turn.T
    optional = {
        "centre_of_mass": st.just((size * draw(vectors(-0.5, 0.5))).tolist()),
        "inertia": st.sampled_from(["solid box", ((matrix + matrix.T) / 2).tolist()]),
        "velocity_max": numbers(1.0, 9.0),
        "acceleration_max": numbers(0.1, 90.0),
        "angular_velocity_max": numbers(1.0, 19.0),
        "angular_acceleration_max": numbers(0.1, 190.0),
        "jerk_max": numbers(1.0, 9000.0),
    }
    return {
        "size": size.tolist(),
        "mass": mass,
        **draw(st.fixed_dictionaries({}, optional=optional)),
    }


@st.composite
def contact_pairs(draw: st.DrawFn, size: list[float]) -> list[dict[str, Any]]:
    axis, first_side = draw(st.integers(0, 2)), draw(st.sampled_from([-1, 1]))
    pair = []
    for side in (first_side, -first_side):
        radius = draw(numbers(0.001, 0.02))
        share = draw(vectors(-1.0, 1.0))
        point = [s * (length / 2 - radius) for s, length in zip(share, size, strict=True)]
        point[axis] = side * size[axis] / 2
        pair.append(
            {
                "xyz": point,
                "spin": draw(numbers(-6, 6)),
                "friction": draw(numbers(0.05, 2)),
                "patch_radius": radius,
            }
        )
    return pair


@st.composite
def tasks(draw: st.DrawFn, bodies: list[str]) -> dict[str, Any]:
    waypoints: list[dict[str, Any]] = []
    initial: list[list[float]] = []
    for index in range(draw(st.integers(1, 4))):
        low = draw(SMALL_POSE)
        if index > 0 and draw(st.booleans()):
            waypoints.append({"fixed": low})
            continue
        width = draw(numbers(1e-3, 0.05))
        free: dict[str, Any] = {"lower": low, "upper": [entry + width for entry in low]}
        count = draw(st.integers(1, 3))
        waypoints.append(free if count == 1 else {**free, "count": count})
        for _ in range(count):
            share = draw(vectors(0.0, 1.0, 6))
            row = [e + s * width for e, s in zip(low, share, strict=True)]
            initial.append(np.clip(row, low, free["upper"]).tolist())
    allowed = st.builds(
        lambda body, departure: {"body": body, "departure": departure},
        st.sampled_from(bodies or ["none"]),
        numbers(1e-3, 0.5),
    )
    optional = {
        "initial": st.just(initial),
        "samples": st.integers(5, 500),
        "time_law": st.sampled_from(["constant", "ramped", "optimal"]),
        "force_limit": st.tuples(numbers(20, 60), numbers(60, 1e4)).map(list),
        "reference_angular_speed": numbers(0.01, 1.0),
        "ramp_time": numbers(0.01, 5.0),
    }
    chosen = draw(st.fixed_dictionaries({}, optional=optional))
    if chosen.get("time_law") == "optimal":
        # Its default, soft fingers, asks for pads that nearly face one another.
        chosen["allocation"] = "paper"
    return {
        "start": draw(SMALL_POSE),
        "waypoints": waypoints,
        "goal": draw(SMALL_POSE),
        "reference_speed": draw(numbers(0.01, 1.0)),
        "reference_force": draw(st.one_of(numbers(20, 1e4), vectors(20, 1e4, 2))),
        "allowed_contacts": draw(st.lists(allowed, max_size=2)) if bodies else [],
        **chosen,
    }


@st.composite
def cells(draw: st.DrawFn) -> dict[str, Any]:
    bodies = [f"body {name}" for name in draw(st.lists(NAMES, max_size=3, unique=True))]
    payload = draw(payloads())
    data: dict[str, Any] = {
        "name": draw(NAMES),
        "robots": [draw(robots("one")), draw(robots("two"))],
        "payload": payload,
        "contacts": draw(contact_pairs(payload["size"])),
        "task": draw(tasks(bodies)),
        "environment": [{"name": name, **draw(shapes())} for name in bodies],
    }
    if draw(st.booleans()):
        ignored = {"first": "payload", "second": "one/link_6", "reason": "they touch"}
        data["collision"] = {"tolerance": draw(numbers(0, 0.05)), "ignored": [ignored]}
    if draw(st.booleans()):
        data["uncertainty"] = {
            "friction": draw(numbers(0, 0.5)),
            "mass": draw(numbers(0, 0.5)),
            "centre_of_mass": draw(vectors(0, 0.1, 3)),
            "disturbance": draw(vectors(0, 5.0, 3)),
            "tracking": draw(numbers(0, 0.5)),
            "internal_force": draw(numbers(0, 100.0)),
            "tilt": draw(numbers(0, 0.4)),
            "relative_position": draw(numbers(0, 0.1)),
            "relative_angle": draw(numbers(0, 0.4)),
            "stiffness": draw(numbers(0, 1e5)),
        }
    if draw(st.booleans()):
        data["handling"] = {
            "stand_off": draw(numbers(0.001, 0.5)),
            "pressing_rate": draw(numbers(1.0, 1e4)),
            "lift_height": draw(numbers(0.0, 0.5)),
        }
    return data
