"""Recordings of ROS 2: MCAP files and rosbag2's folders."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from hybrid_opt.errors import ResultsError
from symbolic.array import Array

ENDINGS = (".mcap", ".db3")

Messages = list[tuple[float, Any]]
"""Messages, each after its time since the recording's begin [s]."""


def is_bag(path: Path) -> bool:
    """Whether a path is a recording of ROS 2, by its name."""
    return path.is_dir() or path.suffix.lower() in ENDINGS


def read_topics(path: Path, topics: Collection[str]) -> dict[str, Messages]:
    """The messages of some topics.

    Raises:
        ResultsError: it cannot be read, lacks a topic, or rosbags is not installed.
    """
    try:
        from rosbags.highlevel import AnyReader, AnyReaderError
        from rosbags.rosbag2 import ReaderError
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise ResultsError(
            "the package rosbags is not installed: pip install 'dual-arm-carry[ros]'"
        ) from error
    found: dict[str, Messages] = {topic: [] for topic in topics}
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
            lacking = sorted(set(topics) - set(reader.topics))
            if lacking:
                has = ", ".join(sorted(reader.topics))[:300]
                raise ResultsError(f"{path}: no topic {lacking[0]!r}; it has {has}")
            wanted = [each for each in reader.connections if each.topic in found]
            for connection, stamp, data in reader.messages(wanted):
                message = reader.deserialize(data, connection.msgtype)
                found[connection.topic].append(((stamp - reader.start_time) * 1e-9, message))
    except ResultsError:
        raise
    # A damaged file makes readers and decoders raise whatever their bytes lead them to.
    except (AnyReaderError, ReaderError, OSError, ValueError, KeyError, IndexError) as error:
        raise ResultsError(f"{path}: no recording that can be read: {error}") from error
    return found


def joint_series(messages: Messages, names: list[str], path: Path) -> tuple[Array, Array]:
    """Times (n,) [s] and positions (n, joints) of JointState messages that have all joints.

    Raises:
        ResultsError: none has.
    """
    times, rows, seen = [], [], set()
    for time, message in messages:
        place = {name: k for k, name in enumerate(message.name)}
        seen |= set(place)
        if all(name in place for name in names):
            times.append(time)
            rows.append([message.position[place[name]] for name in names])
    if not rows:
        lacking = next((name for name in names if name not in seen), names[0])
        has = ", ".join(sorted(seen))[:300]
        raise ResultsError(f"{path}: no joint {lacking!r} in its joint states; they have {has}")
    return np.array(times), np.array(rows, dtype=float)


def wrench_series(messages: Messages) -> tuple[Array, Array]:
    """Times (n,) [s] and wrenches (n, 6) of WrenchStamped or Wrench messages [N, N m]."""
    rows = []
    for _, message in messages:
        wrench: Any = getattr(message, "wrench", message)
        both = (wrench.force, wrench.torque)
        rows.append([getattr(part, axis) for part in both for axis in "xyz"])
    return np.array([time for time, _ in messages]), np.array(rows, dtype=float).reshape(-1, 6)


def force_series(messages: Messages) -> tuple[Array, Array]:
    """Times (n,) [s] and normal forces (n,) [N]: a number, or a wrench along z, either way."""
    if messages and hasattr(messages[0][1], "data"):
        return (
            np.array([time for time, _ in messages]),
            np.array([float(message.data) for _, message in messages]),
        )
    times, wrench = wrench_series(messages)
    return times, np.abs(wrench[:, 2])
