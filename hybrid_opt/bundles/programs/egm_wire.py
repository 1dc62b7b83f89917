"""Messages of ABB's Externally Guided Motion, as bytes (protocol buffers, version 2).

Numbers of fields after egm.proto of RobotWare: EgmRobot header 1 (seqno 1), feedBack 2 (joints 1:
joints 1; externalJoints 3: joints 1), mciState 5, measuredForce 9; EgmSensor header 1 (seqno 1, tm
2, mtype 3), planned 2 (joints 1, externalJoints 3). Joints are in degrees.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

CORRECTION = 3
"""Type of a message to the controller."""

RUNNING = 3
"""State of EGM in which the controller follows."""


@dataclass(frozen=True)
class FromRobot:
    """What a controller tells.

    Attributes:
        number: of the message.
        joints, further: axes of the robot, and external ones [degrees].
        force: of the sensor: force [N] and moment; () without one.
        running: whether the controller follows.
    """

    number: int
    joints: tuple[float, ...]
    further: tuple[float, ...]
    force: tuple[float, ...]
    running: bool


def read_robot(data: bytes) -> FromRobot:
    """A message of a controller.

    Raises:
        ValueError: the bytes are none.
    """
    number, running = 0, False
    joints: tuple[float, ...] = ()
    further: tuple[float, ...] = ()
    force: tuple[float, ...] = ()
    for field, value in _fields(data):
        if isinstance(value, int):
            continue
        inner = list(_fields(value))
        if field == 1:
            number = next((v for f, v in inner if f == 1 and isinstance(v, int)), 0)
        elif field == 2:
            parts = {f: v for f, v in inner if isinstance(v, bytes)}
            joints = _doubles(parts.get(1, b""), (1,))
            further = _doubles(parts.get(3, b""), (1,))
        elif field == 5:
            running = any(f == 1 and v == RUNNING for f, v in inner)
        elif field == 9:
            # Newer controllers tell first whether force control is active.
            force = _doubles(value, (1, 2))
    return FromRobot(number, joints, further, force, running)


def to_robot(number: int, time: float, joints: Sequence[float], further: Sequence[float]) -> bytes:
    """A message that tells a controller where its axes have to be.

    Args:
        time: of the message [s].
        joints, further: axes of the robot, and external ones [degrees].
    """
    header = _number(1, number) + _number(2, round(1e3 * time) % 2**32) + _number(3, CORRECTION)
    planned = _bytes(1, _packed(joints))
    if further:
        planned += _bytes(3, _packed(further))
    return _bytes(1, header) + _bytes(2, planned)


def _packed(values: Sequence[float]) -> bytes:
    # Repeated doubles of version 2 are written one by one.
    return b"".join(_key(1, 1) + struct.pack("<d", value) for value in values)


def _doubles(data: bytes, numbers: tuple[int, ...]) -> tuple[float, ...]:
    found: list[float] = []
    for field, value in _fields(data):
        if field in numbers and isinstance(value, bytes) and len(value) % 8 == 0:
            found += struct.unpack(f"<{len(value) // 8}d", value)
    return tuple(found)


def _fields(data: bytes) -> Iterator[tuple[int, int | bytes]]:
    """Fields with their numbers: varints as numbers, everything else as bytes."""
    place = 0
    while place < len(data):
        key, place = _varint(data, place)
        kind = key & 7
        if kind == 0:
            value, place = _varint(data, place)
            yield key >> 3, value
            continue
        size = {1: 8, 5: 4}.get(kind)
        if kind == 2:
            size, place = _varint(data, place)
        if size is None or place + size > len(data):
            raise ValueError("this is no message of EGM")
        yield key >> 3, data[place : place + size]
        place += size


def _varint(data: bytes, place: int) -> tuple[int, int]:
    value = 0
    for k in range(10):
        if place + k >= len(data):
            break
        value |= (data[place + k] & 0x7F) << (7 * k)
        if data[place + k] < 0x80:
            return value, place + k + 1
    raise ValueError("this is no message of EGM")


def _key(field: int, kind: int) -> bytes:
    return _raw(field << 3 | kind)


def _raw(value: int) -> bytes:
    found = b""
    while value >= 0x80:
        found += bytes([value & 0x7F | 0x80])
        value >>= 7
    return found + bytes([value])


def _number(field: int, value: int) -> bytes:
    return _key(field, 0) + _raw(value)


def _bytes(field: int, value: bytes) -> bytes:
    return _key(field, 2) + _raw(len(value)) + value
