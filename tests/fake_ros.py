"""As much of rclpy, tf2 and message packages as the node uses, for a machine without ROS.

Stand-ins hold callers to what the real ones ask: declared parameters, known QoS, message types with checked fields, a
transform only at a time that was told. They run nothing by themselves: tests call what an executor would.
"""

from __future__ import annotations

import array
import sys
from dataclasses import dataclass, field, fields
from types import ModuleType, SimpleNamespace

import numpy as np
from og_pointcloud_ros.bags import ros2_types
from og_pointcloud_ros.messages import nanoseconds

NUMBERS = {"int": int, "float": float, "str": str, "bool": bool}
"""What rosbags calls the type of a single value -> that of Python."""
TYPES = ros2_types().types


class Message:
    """A message of rclpy's kind: keywords only, unknown ones refused, numbers and bytes of the right type."""

    def __init__(self, **values):
        kinds = {entry.name: entry.type for entry in fields(TYPES[self.type_name])}
        assert set(values) <= set(kinds), f"{self.type_name} has no {set(values) - set(kinds)}"
        for name, kind in kinds.items():
            value = values[name] if name in values else NUMBERS.get(kind, lambda: None)()
            self._check(name, value, NUMBERS.get(kind))
            setattr(self, name, value)

    def _check(self, name, value, number):
        if name == "data":
            assert isinstance(value, (array.array, bytes)), "uint8[] of another type is checked byte by byte: slow"
        elif name == "covariance":
            assert isinstance(value, np.ndarray)
            assert (value.dtype, value.shape) == (np.float64, (36,))
        elif number:
            assert type(value) is number, f"{name} is a {type(value).__name__}, not a {number.__name__}"


def message_package(name, kinds):
    made = {kind: type(kind, (Message,), {"type_name": f"{name}/msg/{kind}"}) for kind in kinds.split()}
    return {name: module(name), f"{name}.msg": module(f"{name}.msg", **made)}


def module(name, **members):
    made = ModuleType(name)
    made.__dict__.update(members)
    return made


@dataclass
class QoSProfile:
    history: str
    depth: int
    reliability: str
    durability: str


@dataclass
class Publisher:
    kind: type
    qos: QoSProfile
    listeners: int = 1
    sent: list = field(default_factory=list)

    def publish(self, message):
        assert isinstance(message, self.kind), f"{type(message)} on a topic of {self.kind}"
        self.sent.append(message)

    def get_subscription_count(self):
        return self.listeners


class Logger:
    def __init__(self):
        self.lines = []

    def info(self, text):
        self.lines.append(("info", text))

    def warning(self, text, throttle_duration_sec):
        assert throttle_duration_sec > 0
        self.lines.append(("warning", text))

    def fatal(self, text):
        self.lines.append(("fatal", text))


class Parameter:
    def __init__(self, name, value=None):
        assert not (isinstance(value, list) and not value), "an empty list has no type"
        self.name, self.value = name, value


class Node:
    overrides: dict = {}  # noqa: RUF012
    """What the command line sets; a test fills it."""

    def __init__(self, name, **options):
        assert not options
        self.name, self.parameters, self.publishers, self.subscriptions, self.timers = name, {}, {}, {}, []
        self.services = {}
        self.logger, self.checks, self.destroyed = Logger(), [], False

    def declare_parameter(self, name, default):
        assert name not in self.parameters
        value = self.overrides.get(name, default)
        assert type(value) is type(default), f"{name} has type {type(value)}, was declared {type(default)}"
        self.parameters[name] = value

    def get_parameter(self, name):
        return SimpleNamespace(value=self.parameters[name])

    def add_on_set_parameters_callback(self, check):
        self.checks.append(check)

    def set_parameters(self, parameters):
        results = []
        for parameter in parameters:
            answers = [check([parameter]) for check in self.checks]
            refused = [answer for answer in answers if not answer.successful]
            if not refused:
                self.parameters[parameter.name] = parameter.value
            results.append(refused[0] if refused else answers[0])
        return results

    def create_publisher(self, kind, topic, qos):
        assert topic not in self.publishers
        return self.publishers.setdefault(topic, Publisher(kind, qos))

    def create_subscription(self, kind, topic, callback, qos):
        self.subscriptions[topic] = SimpleNamespace(kind=kind, callback=callback, qos=qos)

    def create_service(self, kind, name, callback):
        self.services[name] = lambda: callback(kind.Request(), kind.Response())

    def create_timer(self, seconds, callback):
        assert seconds > 0
        self.timers.append(callback)

    def get_clock(self):
        return SimpleNamespace(now=lambda: SimpleNamespace(to_msg=lambda: SimpleNamespace(sec=12, nanosec=34)))

    def get_logger(self):
        return self.logger

    def destroy_node(self):
        self.destroyed = True


class TriggerResponse:
    """Of std_srvs/Trigger."""

    __slots__ = ("message", "success")


class TransformException(Exception):
    """tf2's."""


class Buffer:
    def __init__(self):
        self.told = {}

    def lookup_transform(self, target, source, moment):
        found = self.told.get((target, source, moment.nanoseconds))
        if found is None:
            raise TransformException(f'"{source}" passed to lookupTransform does not exist')
        return found

    def tell(self, target, source, stamp, translation, xyzw):
        place, turn = (SimpleNamespace(**dict(zip("xyzw", at, strict=False))) for at in (translation, xyzw))
        transform = SimpleNamespace(translation=place, rotation=turn)
        self.told[target, source, stamp] = SimpleNamespace(transform=transform)


class Time:
    def __init__(self, nanoseconds):
        self.nanoseconds = nanoseconds

    @classmethod
    def from_msg(cls, stamp):
        if stamp.sec < 0:
            raise ValueError("Seconds value must not be negative")
        return cls(nanoseconds(stamp))


def install(monkeypatch):
    """Put the stand-ins where ``import rclpy`` and the others look; gone again after the test. Returns rclpy."""
    monkeypatch.setattr(Node, "overrides", {})
    state = {"running": False, "spun": [], "log": Logger()}

    def init(args=None):
        assert not state["running"]
        state["running"] = True

    def spin(node):
        assert state["running"]
        state["spun"].append(node)
        raise KeyboardInterrupt

    def try_shutdown():
        state["running"] = False

    rclpy = module("rclpy", init=init, spin=spin, try_shutdown=try_shutdown, state=state)
    rclpy.logging = module("rclpy.logging", get_logger=lambda name: state["log"])
    rclpy.executors = module("rclpy.executors", ExternalShutdownException=type("Stopped", (Exception,), {}))
    policies = {
        "QoSHistoryPolicy": SimpleNamespace(KEEP_LAST="keep last"),
        "QoSReliabilityPolicy": SimpleNamespace(RELIABLE="reliable", BEST_EFFORT="best effort"),
        "QoSDurabilityPolicy": SimpleNamespace(VOLATILE="volatile", TRANSIENT_LOCAL="transient local"),
    }
    result = type("SetParametersResult", (), {"__init__": lambda self, **values: self.__dict__.update(values)})
    modules = {
        "rclpy": rclpy,
        "rclpy.logging": rclpy.logging,
        "rclpy.executors": rclpy.executors,
        "rclpy.node": module("rclpy.node", Node=Node),
        "rclpy.qos": module("rclpy.qos", QoSProfile=QoSProfile, **policies),
        "rclpy.time": module("rclpy.time", Time=Time),
        "rcl_interfaces": module("rcl_interfaces"),
        "rcl_interfaces.msg": module("rcl_interfaces.msg", SetParametersResult=result),
        "tf2_ros": module(
            "tf2_ros",
            Buffer=Buffer,
            TransformException=TransformException,
            TransformListener=lambda buffer, node: SimpleNamespace(buffer=buffer, node=node),
        ),
        **message_package("std_msgs", "Header"),
        **message_package("builtin_interfaces", "Time"),
        **message_package("sensor_msgs", "PointCloud2 PointField Image CompressedImage CameraInfo RegionOfInterest"),
        "std_srvs": module("std_srvs"),
        "std_srvs.srv": module("std_srvs.srv", Trigger=SimpleNamespace(Request=object, Response=TriggerResponse)),
        **message_package("geometry_msgs", "Point Vector3 Quaternion Pose PoseWithCovariance"),
        **message_package(
            "vision_msgs",
            "Detection3DArray Detection3D ObjectHypothesis ObjectHypothesisWithPose BoundingBox3D "
            "LabelInfo VisionClass",
        ),
    }
    for name, stand_in in modules.items():
        monkeypatch.setitem(sys.modules, name, stand_in)
    for name in ("og_pointcloud_ros.node", "og_pointcloud_ros.map_node"):  # they hold the stand-ins
        monkeypatch.setitem(sys.modules, name, None)  # so that what the test imports is gone again after it
        del sys.modules[name]
    return rclpy
