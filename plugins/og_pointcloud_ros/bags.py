"""A ROS 2 bag in, the same bag with labels out, without ROS: rosbags reads and writes files and messages.

The new bag holds all messages of the old one, byte for byte, and with each cloud its labels and detections.
"""

from __future__ import annotations

import os
import time
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from og_pointcloud.ask.choosing import Reason
from og_pointcloud.ask.labelled_scene import Segmenter
from og_pointcloud.errors import OgPointcloudError, SceneError, first_line, naming_extra, printable
from og_pointcloud.formats.atomic import replacing_folder
from og_pointcloud.journal import with_bar
from og_pointcloud_ros.detections import to_label_info
from og_pointcloud_ros.labelling import MINIMUM_POINTS, CloudLabeller, LabelledMessages
from og_pointcloud_ros.messages import MessageFactory, nanoseconds
from og_pointcloud_ros.transforms import TransformTree

with naming_extra("rosbags", "ros"):
    from rosbags.interfaces import Connection, Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
    from rosbags.rosbag2 import Reader, StoragePlugin, Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    from rosbags.typesys.store import Typestore

CLOUD, TRANSFORMS = "sensor_msgs/msg/PointCloud2", "tf2_msgs/msg/TFMessage"
DETECTION_ARRAY, INFO = "vision_msgs/msg/Detection3DArray", "vision_msgs/msg/LabelInfo"
LABELLED = "/labelled"
OUTPUTS = {LABELLED: CLOUD, "/detections": DETECTION_ARRAY}
"""Suffix appended to a cloud's topic for each output -> its type; in the order of `LabelledMessages`."""
LABEL_INFO = "/og_pointcloud/label_info"
BAG_VERSION = 8
"""Version of rosbag2's metadata, which Humble and all later releases read."""
INFINITE_DURATION = QosTime(2147483647, 4294967295)
"""ROS 2's infinite duration: no deadline, no lifespan."""
LATCHED_QOS = Qos(
    QosHistory.KEEP_LAST, 1, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL, INFINITE_DURATION,
    INFINITE_DURATION, QosLiveliness.AUTOMATIC, INFINITE_DURATION, False,
)  # fmt: skip
UNKNOWN_TYPE_HASH = "RIHS01_" + "0" * 64
"""Hash of a type that neither the bag defines nor rosbags knows: bags of Humble and older store only type names."""

VISION_MSGS: Mapping[str, str] = {
    "vision_msgs/msg/VisionClass": "uint16 class_id\nstring class_name",
    "vision_msgs/msg/LabelInfo": "std_msgs/Header header\nvision_msgs/VisionClass[] class_map\nfloat32 threshold",
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score",
    "vision_msgs/msg/ObjectHypothesisWithPose": (
        "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose"
    ),
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size",
    "vision_msgs/msg/Detection3D": (
        "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
        "vision_msgs/BoundingBox3D bbox\nstring id"
    ),
    "vision_msgs/msg/Detection3DArray": "std_msgs/Header header\nvision_msgs/Detection3D[] detections",
}
"""Message definitions of vision_msgs 4, the version of ROS 2 Humble and later."""


@dataclass
class BagReport:
    """Result of ``label_bag``. topics: a cloud's topic -> the topic of its labels. seconds: wall time spent on clouds.

    skipped: number of clouds that could not be labelled, by reason. counts: number of points of each name.
    """

    topics: dict[str, str]
    clouds: int = 0
    points: int = 0
    detections: int = 0
    counts: Counter[str] = field(default_factory=Counter)
    unknown_because: Counter[Reason] = field(default_factory=Counter)
    skipped: Counter[str] = field(default_factory=Counter)
    seconds: float = 0.0

    def add(self, labelled: LabelledMessages) -> None:
        """Count one cloud."""
        self.clouds += 1
        self.points += len(labelled.result)
        self.detections += len(labelled.detections.detections)
        self.counts.update(labelled.result.counts())
        self.unknown_because.update(labelled.result.unknown_because())


def label_bag(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    segmenter: Segmenter,
    *,
    topics: Sequence[str] | None = None,
    frame: str = "map",
    minimum_points: int = MINIMUM_POINTS,
    progress: bool = False,
) -> BagReport:
    """Copy a ROS 2 bag and label its clouds, placed in the scene by /tf and /tf_static.

    source: a bag's folder, .db3 or .mcap, its messages with zstd or without. target: the folder to create, with the
    same storage; it appears once it is complete. topics: PointCloud2 topics to label, None for all. frame: the scene's
    frame. progress: show a bar with the remaining time if stderr is a terminal.
    The labels of a cloud on ``T`` are on ``T/labelled``, in the cloud's own frame, the boxes on ``T/detections``, in
    the scene's; the names are on /og_pointcloud/label_info, latched. A cloud without a transform, or damaged, is
    skipped. SceneError if it is no such bag or has no such topic, or if no cloud can be labelled.
    """
    source, target = Path(source), Path(target)
    if target.exists():
        raise SceneError(f"'{target}' already exists; expected a new name: bags are never replaced")
    with open_bag(source) as reader:
        clouds, store = _cloud_topics(reader, topics), ros2_types()
        report = BagReport({topic: topic + LABELLED for topic in clouds})
        tree = transforms_of(reader, store)  # read all first: the transform after a cloud is needed too
        messages = rosbags_messages(store)
        labeller = CloudLabeller(segmenter, messages, frame, minimum_points)
        with (
            replacing_folder(target) as folder,  # of the target's name: a bag names its files after its folder
            Writer(folder, version=BAG_VERSION, storage_plugin=_storage(source)) as bag,
        ):
            # Publishers of one topic and type that differ in QoS are several connections; in the new bag they are one.
            by_key = {(old.topic, old.msgtype): old for old in reader.connections}
            copies = {key: _copied(bag, old, store) for key, old in by_key.items()}
            info = bag.add_connection(LABEL_INFO, INFO, typestore=store, offered_qos_profiles=[LATCHED_QOS])
            names = to_label_info(segmenter.names, stamp=reader.start_time, messages=messages)
            bag.write(info, reader.start_time, store.serialize_cdr(names, INFO))
            ours = {
                topic: [bag.add_connection(topic + ending, kind, typestore=store) for ending, kind in OUTPUTS.items()]
                for topic in clouds
            }
            for old, stamp, data in with_bar(messages_of(reader), "messages", reader.message_count, progress):
                bag.write(copies[old.topic, old.msgtype], stamp, data)
                # Labels follow their cloud, at its time.
                if old.topic in clouds and (labelled := _label(store, data, tree, frame, labeller, report)):
                    for new, message in zip(ours[old.topic], labelled[1:], strict=True):
                        bag.write(new, stamp, store.serialize_cdr(message, new.msgtype))
            if not report.clouds:
                reason = next(iter(report.skipped), "its topics have no messages")
                raise SceneError(f"{source}: no cloud can be labelled: {reason}")
    return report


def _label(
    store: Any, data: bytes, tree: TransformTree, frame: str, labeller: CloudLabeller, report: BagReport
) -> LabelledMessages | None:
    """One cloud's messages, or None where it was skipped; the report counts both."""
    start = time.perf_counter()
    try:
        message = decoded(store, data, CLOUD)
        pose = tree.lookup(frame, message.header.frame_id, nanoseconds(message.header.stamp))
        labelled = labeller(message, pose)
    except Exception as error:  # one bad cloud, whatever is in it, does not affect the others
        kind = "" if isinstance(error, OgPointcloudError) else f"{type(error).__name__}: "
        report.skipped[kind + first_line(error)] += 1
        return None
    finally:
        report.seconds += time.perf_counter() - start
    report.add(labelled)
    return labelled


@contextmanager
def open_bag(source: str | os.PathLike[str]) -> Iterator[Reader]:
    """rosbags' reader of a ROS 2 bag; SceneError, with the cause, for anything else."""
    path = Path(source)
    if path.is_file() and path.suffix == ".bag":
        raise SceneError(
            f"{path} is a ROS 1 bag; expected a ROS 2 bag: rosbags-convert --src {path} --dst {path.with_suffix('')}"
        )
    if not path.exists() or (path.is_dir() and not (path / "metadata.yaml").is_file()):
        raise SceneError(f"{path} is not a bag; expected a folder with a metadata.yaml, or a .db3 or .mcap file")
    if packed := next((file for file in (path, *path.glob("*")) if file.suffix in (".zstd", ".zst")), None):
        raise SceneError(
            f"{path} is compressed as whole files ({packed.name}), so its unpacked size is unknown; expected messages "
            "compressed one by one, or not at all: use 'ros2 bag convert'"
        )
    try:
        reader = Reader(path)
        reader.open()
    except Exception as error:  # of rosbags, of its databases, of YAML
        raise SceneError(f"{path} cannot be read as a bag ({first_line(error)}): record or copy it again") from None
    try:
        yield reader
    finally:
        reader.close()


def _copied(bag: Writer, old: Connection, store: Any) -> Connection:
    """The new bag's connection for a topic of the old one, with its type definition and QoS."""
    ext: Any = old.ext
    # Defined as in the old bag; a type that it only names is defined by rosbags, if it knows it.
    definition: dict[str, Any] = {"msgdef": old.msgdef.data, "rihs01": old.digest or UNKNOWN_TYPE_HASH}
    if not (old.msgdef.data and old.digest) and old.msgtype in store.types:
        definition = {"typestore": store}
    return bag.add_connection(
        old.topic, old.msgtype, **definition, serialization_format=ext.serialization_format,
        offered_qos_profiles=ext.offered_qos_profiles,
    )  # fmt: skip


def _cloud_topics(reader: Reader, topics: Sequence[str] | None) -> list[str]:
    """The topics to label. SceneError for one that is missing or no cloud, and for a bag that is already labelled."""
    types = {connection.topic: connection.msgtype for connection in reader.connections}
    all_clouds = sorted(topic for topic, kind in types.items() if kind == CLOUD and not topic.endswith(LABELLED))
    wanted = list(dict.fromkeys(topics)) if topics else all_clouds
    known = f"its topics with clouds are {', '.join(all_clouds)}" if all_clouds else "it has no topic with clouds"
    for topic in wanted:
        if types.get(topic) != CLOUD:
            what = f"carries {types[topic]}" if topic in types else "is not in the bag"
            raise SceneError(f"topic '{topic}' {what}; expected a topic of {CLOUD}: {known}")
    taken = [name for topic in wanted for name in (topic + ending for ending in OUTPUTS) if name in types]
    if taken or LABEL_INFO in types:
        raise SceneError(f"the bag already has a topic '{[*taken, LABEL_INFO][0]}'; expected a bag without labels")
    if not wanted:
        raise SceneError(f"no cloud to label: {known}; it has {', '.join(sorted(types)) or 'nothing at all'}")
    return wanted


def transforms_of(reader: Reader, store: Any) -> TransformTree:
    """All transforms of /tf and /tf_static; invalid messages are left out, with a warning."""
    tree, damaged = TransformTree(), Counter[str]()
    connections = [old for old in reader.connections if old.msgtype == TRANSFORMS]
    for connection, _, data in messages_of(reader, connections) if connections else ():
        try:
            tree.add_message(decoded(store, data, TRANSFORMS), static=connection.topic.endswith("tf_static"))
        except Exception as error:  # of decoding, or of values that are no transform
            damaged[first_line(error)] += 1
    if damaged:
        example = printable(next(iter(damaged)))
        warnings.warn(f"{damaged.total()} transform messages left out: {example}", stacklevel=3)
    return tree


def messages_of(reader: Reader, connections: Sequence[Connection] = ()) -> Iterator[tuple[Connection, int, bytes]]:
    """Connection, stamp in nanoseconds and bytes of each message; of all connections if none are given."""
    try:
        yield from reader.messages(connections)
    except Exception as error:  # of rosbags or of its databases
        raise SceneError(f"{reader.path} cannot be read fully ({first_line(error)}): record or copy it again") from None


def decoded(store: Any, data: bytes, kind: str) -> Any:
    """A message of this type; SceneError for invalid bytes."""
    try:
        return store.deserialize_cdr(data, kind)
    except Exception as error:  # a damaged message may end anywhere
        raise SceneError(f"a {kind} cannot be decoded ({first_line(error)})") from None


def _storage(source: Path) -> StoragePlugin:
    """The storage type of the source, a file or a folder of files."""
    files = [source] if source.is_file() else list(source.iterdir())
    return StoragePlugin.MCAP if any(".mcap" in file.suffixes for file in files) else StoragePlugin.SQLITE3


def ros2_types() -> Typestore:
    """Types of ROS 2 Humble, with the clouds and transforms of every later release, and vision_msgs."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, fields in VISION_MSGS.items():
        store.register(get_types_from_msg(fields, name))
    return store


def rosbags_messages(store: Typestore) -> MessageFactory:
    """Makes messages of rosbags' types, of ROS 2 or ROS 1, ready for ``store.serialize_cdr`` or ``serialize_ros1``."""

    def make(type_name: str, /, **fields: Any) -> Any:
        kind: Any = store.types[type_name]
        if "seq" in getattr(kind, "__dataclass_fields__", ()):  # a header of ROS 1
            fields["seq"] = 0
        return kind(**fields)

    return make
