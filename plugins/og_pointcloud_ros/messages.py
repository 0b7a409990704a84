"""Making ROS messages without ROS.

All code that makes messages takes a ``MessageFactory``, so that the same lines fill plain objects, rosbags' types
(``bags.rosbags_messages``) and rclpy's. Reading needs no factory: a message is any object with its attributes.
"""

from __future__ import annotations

import array
import importlib
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np

from og_pointcloud.errors import SceneError

NANOSECONDS = 1_000_000_000


MessageFactory = Callable[..., Any]
"""Makes a message of a type such as "std_msgs/msg/Header", the only positional argument, from all of its fields.

Fields hold messages of the same factory, sequences of such, numbers, strings, and numpy arrays where the message has a
sequence or array of numbers.
"""


def plain_messages(type_name: str, /, **fields: Any) -> Any:
    """Plain objects with the message's fields, of a class with its name, without ROS or rosbags."""
    return type(type_name.rpartition("/")[2], (SimpleNamespace,), {})(**fields)


def ros_messages(type_name: str, /, **fields: Any) -> Any:
    """Messages of a ROS 2 installation, imported only here."""
    package, _, name = type_name.partition("/msg/")
    kind = getattr(importlib.import_module(f"{package}.msg"), name)
    # rclpy takes an array.array of bytes as it is, but checks anything else byte by byte.
    for key, value in fields.items():
        if isinstance(value, np.ndarray) and value.dtype == np.uint8:
            fields[key] = array.array("B", value.tobytes())
    return kind(**fields)


def header(messages: MessageFactory, frame_id: str, stamp: Any) -> Any:
    """A std_msgs/Header. stamp: a Time message, nanoseconds since the epoch, or None for 0."""
    return messages("std_msgs/msg/Header", stamp=time_message(messages, stamp), frame_id=frame_id)


def time_message(messages: MessageFactory, stamp: Any) -> Any:
    """A builtin_interfaces/Time. stamp: as for `header`."""
    sec, nanosec = divmod(nanoseconds(stamp), NANOSECONDS)
    return messages("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)


def nanoseconds(stamp: Any) -> int:
    """Nanoseconds since the epoch, from a Time message, an integer number of nanoseconds, or None, which is 0."""
    if stamp is None:
        return 0
    if hasattr(stamp, "sec") and hasattr(stamp, "nanosec"):
        return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)
    if isinstance(stamp, (int, np.integer)):
        return int(stamp)
    raise SceneError(f"stamp is a {type(stamp).__name__}; expected a Time message or nanoseconds since the epoch")
