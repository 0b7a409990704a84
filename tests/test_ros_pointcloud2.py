"""PointCloud2 in and out: every layout against a plain reader, and both ways through rosbags' own serialisation."""

import array
import struct
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from og_pointcloud_ros import (
    UNLABELLED,
    from_pointcloud2,
    read_fields,
    to_detections,
    to_label_info,
    to_pointcloud2,
    write_fields,
)
from og_pointcloud_ros.labelling import CloudLabeller
from og_pointcloud_ros.messages import nanoseconds, plain_messages

import og_pointcloud as og
from og_pointcloud.formats.colors import label_colors

STRUCT_CODES = {1: "b", 2: "B", 3: "h", 4: "H", 5: "i", 6: "I", 7: "f", 8: "d"}
SIZES = {number: struct.calcsize("<" + code) for number, code in STRUCT_CODES.items()}


def PointField(name, offset=0, datatype=7, count=1):
    return SimpleNamespace(name=name, offset=offset, datatype=datatype, count=count)


def Time(sec, nanosec):
    return SimpleNamespace(sec=sec, nanosec=nanosec)


def message(height=1, width=2, kinds=(7, 7, 7), names="xyz", big=False, gap=0, row_gap=0, lead=0, seed=0):
    """A cloud of random bytes; gap: padding after each field, lead: before the first, row_gap: after each row."""
    offset, fields = lead, []
    for name, kind in zip(names, kinds, strict=True):
        fields.append(PointField(name, offset, kind, 1))
        offset += SIZES[kind] + gap
    row_step = width * offset + row_gap
    data = np.random.default_rng(seed).integers(0, 256, height * row_step, np.uint8)
    return SimpleNamespace(
        header=None, height=height, width=width, fields=fields, is_bigendian=big, point_step=offset, row_step=row_step,
        data=data, is_dense=False,
    )  # fmt: skip


def read_plainly(cloud):
    """The x y z of every point, one struct.unpack at a time."""
    fields = {field.name: field for field in cloud.fields}
    rows, data = [], bytes(cloud.data)
    for row in range(cloud.height):
        for column in range(cloud.width):
            start = row * cloud.row_step + column * cloud.point_step
            order = ">" if cloud.is_bigendian else "<"
            for field in (fields[axis] for axis in "xyz"):
                rows += struct.unpack_from(order + STRUCT_CODES[field.datatype], data, start + field.offset)
    return np.array(rows, np.float64).reshape(-1, 3)


@given(
    height=st.integers(1, 4), width=st.integers(0, 5), kinds=st.lists(st.integers(1, 8), min_size=4, max_size=4),
    names=st.permutations("xyzi"), big=st.booleans(), gap=st.integers(0, 5), row_gap=st.integers(0, 9),
    lead=st.integers(0, 3), seed=st.integers(0, 2**32 - 1),
)  # fmt: skip
@settings(max_examples=150, deadline=None)
def test_every_layout_reads_as_the_plain_reader_does(**layout):
    cloud = message(**layout)
    with np.errstate(invalid="ignore"):
        xyz = from_pointcloud2(cloud)
    assert xyz.dtype == np.float64
    np.testing.assert_array_equal(xyz, read_plainly(cloud))


@pytest.mark.parametrize("carrier", [bytes, bytearray, memoryview, list, lambda data: array.array("B", data.tobytes())])
def test_whatever_carries_the_bytes(carrier):
    cloud = message(kinds=(3, 3, 3))
    expected = read_plainly(cloud)
    cloud.data = carrier(cloud.data.tobytes()) if carrier in (bytes, bytearray, memoryview) else carrier(cloud.data)
    np.testing.assert_array_equal(from_pointcloud2(cloud), expected)


def test_fields_are_a_view_of_the_message():
    cloud = message(height=3, width=4, names="zxyi", kinds=(7, 7, 7, 2), row_gap=6)
    rows = read_fields(cloud)
    assert rows.shape == (3, 4)
    assert np.shares_memory(rows, cloud.data)
    rows["i"] = 77
    assert cloud.data[12] == 77


def test_a_last_row_without_padding_and_a_single_row_without_a_step():
    cloud = message(height=2, width=2, row_gap=8)
    expected = read_plainly(cloud)
    cloud.data = cloud.data[:-8]
    np.testing.assert_array_equal(from_pointcloud2(cloud), expected)
    single = message(width=3)
    expected = read_plainly(single)
    single.row_step = 0
    np.testing.assert_array_equal(from_pointcloud2(single), expected)


def test_unnamed_fields_are_padding_and_counts_are_columns():
    cloud = message(names=["x", "", "y", "", "z"], kinds=(7,) * 5)
    cloud.fields.append(PointField("ring", 0, 4, 10))
    assert from_pointcloud2(cloud).shape == (2, 3)
    assert read_fields(cloud)["ring"].shape == (1, 2, 10)


@pytest.mark.parametrize("cloud", [message(names="", kinds=(), height=0), message(width=0), message(height=0, width=5)])
def test_no_points(cloud):
    assert from_pointcloud2(cloud).shape == (0, 3)


HOSTILE = {
    "cut off": ({"data": b"123"}, "has 3 bytes; expected 24"),
    "too long": ({"data": bytes(25)}, "has 25 bytes; expected 24"),
    "more points than bytes": ({"width": 2**32 - 1}, "expected 51539607540"),
    "rows that overlap": ({"height": 2, "width": 2, "row_step": 12, "data": bytes(36)}, "rows of 12"),
    "a field beyond the point": ({"point_step": 11}, "field 'z' of a PointCloud2 spans bytes 8 to 12"),
    "a huge count": ({"fields": [PointField("x", 0, 7, 2**32 - 1)]}, "spans bytes 0 to 17179869180"),
    "no such type": ({"fields": [PointField("x", 0, 9, 1)]}, "datatype 9; expected 1"),
    "twice one name": ({"fields": [PointField("x", 0), PointField("x", 4)]}, "appears twice"),
    "no fields": ({"fields": None}, "fields of a PointCloud2 are damaged"),
    "no PointField": ({"fields": ["x", "y", "z"]}, "fields of a PointCloud2 are damaged"),
    "no offset": ({"fields": [PointField("x", "four")]}, "fields of a PointCloud2 are damaged"),
    "a name of bytes": ({"fields": [PointField(b"x")]}, "fields of a PointCloud2 are damaged"),
    "no z": ({"fields": [PointField("x", 0), PointField("y", 4)]}, r"field 'z' .* is absent \(its fields: x, y\)"),
    "no field at all": ({"fields": [], "point_step": 12}, r"is absent \(its fields: none\)"),
    "three x": (
        {"fields": [PointField("x", 0, 7, 3), PointField("y"), PointField("z")]}, "field 'x' .* has 3 values",
    ),
    "points of no bytes": ({"fields": [], "point_step": 0, "row_step": 0, "data": b""}, "points of 0 bytes"),
    "a negative width": ({"width": -1}, "width of a PointCloud2 is -1"),
    "a width in words": ({"width": "2"}, "width of a PointCloud2 is '2'"),
    "no bytes": ({"data": None}, "data of a PointCloud2 is a NoneType"),
}  # fmt: skip


@pytest.mark.parametrize(("changes", "text"), HOSTILE.values(), ids=HOSTILE)
def test_a_message_that_contradicts_itself_is_one_clear_error(changes, text):
    cloud = message()
    for name, value in changes.items():
        setattr(cloud, name, value)
    with pytest.raises(og.SceneError, match=text):
        from_pointcloud2(cloud)


def test_what_is_no_cloud():
    with pytest.raises(og.SceneError, match="a ndarray has no 'height'"):
        from_pointcloud2(np.zeros((3, 3)))
    with pytest.raises(og.SceneError, match="a SimpleNamespace has no 'width'"):
        from_pointcloud2(SimpleNamespace(height=1))


# Out ------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def result(scene):
    return og.segment(np.concatenate([scene.xyz[:200], [[9, 9, 9], [np.nan, 0, 0]]]), ["apple", "pear", "plum"], scene)


def test_an_organized_cloud_stays_organized(scene):
    rows = np.zeros((3, 4), [(axis, "<f4") for axis in "zyx"])
    for axis, values in zip("xyz", scene.xyz[:12].T, strict=True):
        rows[axis] = values.reshape(3, 4)
    segmenter = og.Segmenter(scene, ["apple", "pear", "plum"])
    cloud = CloudLabeller(segmenter, plain_messages)(write_fields(rows, "map"), np.eye(4)).points
    assert (cloud.height, cloud.width, cloud.row_step) == (3, 4, 4 * 28)
    np.testing.assert_array_equal(read_fields(cloud)["x"], rows["x"])
    np.testing.assert_array_equal(read_fields(cloud)["instance"].ravel(), segmenter(scene.xyz[:12]).instances)
    with pytest.raises(og.SceneError, match=r"xyz has shape \(4, 4\); expected \(12, 3\), one row per label, or \("):
        to_pointcloud2(segmenter(scene.xyz[:12]), xyz=np.zeros((4, 4)))


def test_a_labelled_cloud_says_what_the_result_says(result):
    cloud = to_pointcloud2(result, "map", 3_000_000_007)
    rows = read_fields(cloud)[0]
    assert (cloud.header.frame_id, cloud.header.stamp) == ("map", Time(3, 7))
    assert [field.name for field in cloud.fields] == ["x", "y", "z", "rgb", "label", "instance", "score"]
    assert [field.datatype for field in cloud.fields] == [7, 7, 7, 7, 6, 5, 7]
    assert (cloud.point_step, cloud.height, cloud.width, cloud.is_dense) == (28, 1, 202, False)
    np.testing.assert_array_equal(from_pointcloud2(cloud), result.xyz.astype(np.float32).astype(np.float64))
    assert set(rows["label"][result.labels < 0]) == {UNLABELLED}
    np.testing.assert_array_equal(rows["label"][result.labels >= 0], result.labels[result.labels >= 0])
    np.testing.assert_array_equal(rows["instance"], result.instances)
    np.testing.assert_array_equal(rows["score"], result.scores)
    bits = rows["rgb"].copy().view("<u4")
    unpacked = np.stack([bits >> 16, bits >> 8 & 255, bits & 255], axis=1)
    np.testing.assert_array_equal(unpacked, label_colors(result.labels))


def test_an_empty_result_is_an_empty_cloud(scene):
    with pytest.warns(UserWarning, match="0 points"):
        empty = og.segment(np.zeros((0, 3)), ["apple"], scene)
    cloud = to_pointcloud2(empty)
    assert (cloud.width, len(cloud.data), len(cloud.fields)) == (0, 0, 7)
    assert from_pointcloud2(cloud).shape == (0, 3)


def test_map_coordinates_survive_as_doubles(result):
    far = result.xyz + 4e6
    assert np.nanmax(np.abs(from_pointcloud2(to_pointcloud2(result, xyz=far, double=False)) - far)) > 0.05
    for of_map in (to_pointcloud2(result, xyz=far), replace(result, xyz=far).to_pointcloud2("utm")):
        np.testing.assert_array_equal(from_pointcloud2(of_map), far)
    np.testing.assert_array_equal(from_pointcloud2(to_pointcloud2(result, double=True)), result.xyz)
    near = replace(result, xyz=np.concatenate([result.xyz[:-1], [[1e300, 0, 0]]]))  # a stray reading is no map
    for cloud in (to_pointcloud2(near), to_pointcloud2(result, xyz=far.astype(np.float32))):
        assert [field.datatype for field in cloud.fields[:3]] == [7, 7, 7]
    with pytest.raises(og.SceneError, match=r"expected \(202, 3\)"):
        to_pointcloud2(result, xyz=far[1:])


@pytest.mark.parametrize("order", ["<", ">"])
def test_fields_written_are_fields_read(order):
    rows = np.zeros(
        (2, 3), [(f"f{code}", order + code) for code in ("i1", "u2", "i4", "f4", "f8")] + [("three", "u1", 3)]
    )
    rows["ff4"], rows["fi4"], rows["three"] = 1.5, -7, (1, 2, 3)
    np.testing.assert_array_equal(read_fields(write_fields(rows, "lidar")), rows)
    with pytest.raises(og.SceneError, match="cannot hold"):
        write_fields(np.zeros(3, [("t", "i8")]), "lidar")
    with pytest.raises(og.SceneError, match="cannot hold"):
        write_fields(np.zeros(3), "lidar")


def test_stamps():
    assert [nanoseconds(stamp) for stamp in (None, 5, Time(2, 3))] == [0, 5, 2_000_000_003]
    with pytest.raises(og.SceneError, match="stamp is a float"):
        nanoseconds(1.5)


def test_detections_are_the_labelled_instances_in_sight(scene, result):
    detections = to_detections(scene, result, "map", 5).detections
    labelled = result.labels >= 0
    assert [int(detection.id) for detection in detections] == sorted(set(result.instances[labelled].tolist()))
    for detection in detections:
        k = int(detection.id)
        row = np.flatnonzero(result.instances == k)[0]
        hypothesis = detection.results[0].hypothesis
        assert hypothesis.class_id == result.names[result.labels[row]]
        assert hypothesis.score == pytest.approx(float(result.scores[row]))
        corners = corners_of(detection.bbox)
        box = scene.instances[k].oriented_box
        assert sorted(map(tuple, np.round(corners, 6))) == sorted(map(tuple, np.round(box.corners, 6)))
    most = max(np.bincount(result.instances[labelled]))
    assert len(to_detections(scene, result, minimum_points=int(most)).detections) < len(detections)


def corners_of(bbox):
    """Corners of a message's box, by Hamilton's product of its quaternion."""
    q, p = bbox.center.orientation, bbox.center.position
    u, w = np.array([q.x, q.y, q.z]), q.w
    assert u @ u + w * w == pytest.approx(1)
    signs = np.array([(a, b, c) for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)])
    local = signs * [bbox.size.x, bbox.size.y, bbox.size.z] / 2
    turned = local + 2 * np.cross(u, np.cross(u, local) + w * local)
    return turned + np.array([p.x, p.y, p.z])


def test_a_result_of_another_scene_is_refused(scene, result):
    with pytest.raises(og.OgPointcloudError, match="they are from different scenes"):
        to_detections(scene.instances[:1], result)


def test_label_info():
    info = to_label_info(["apple", "Tür"])
    assert [(entry.class_id, entry.class_name) for entry in info.class_map] == [(0, "apple"), (1, "Tür")]
    with pytest.raises(og.OgPointcloudError, match="at most 65535"):
        to_label_info(["a"] * 65536)


# Through rosbags' serialisation ---------------------------------------------------------------------------------


@pytest.fixture(scope="module", params=["ROS 2", "ROS 1"])
def wire(request):
    """Message -> bytes -> message, as rosbags has it, and the factory of its types."""
    pytest.importorskip("rosbags")
    from og_pointcloud_ros.bags import VISION_MSGS, ros2_types, rosbags_messages
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    if request.param == "ROS 2":
        store = ros2_types()
        return rosbags_messages(store), lambda value, kind: store.deserialize_cdr(
            store.serialize_cdr(value, kind), kind
        )
    store = get_typestore(Stores.ROS1_NOETIC)
    for name, fields in VISION_MSGS.items():
        store.register(get_types_from_msg(fields, name))
    return rosbags_messages(store), lambda value, kind: store.deserialize_ros1(store.serialize_ros1(value, kind), kind)


def test_clouds_through_the_wire(wire, result):
    make, there_and_back = wire
    cloud = there_and_back(to_pointcloud2(result, "map", 7, messages=make), "sensor_msgs/msg/PointCloud2")
    plain = to_pointcloud2(result, "map", 7)
    assert read_fields(cloud).dtype == read_fields(plain).dtype
    assert bytes(cloud.data) == bytes(plain.data)
    assert nanoseconds(cloud.header.stamp) == 7


@pytest.mark.parametrize("big", [False, True])
def test_layouts_through_the_wire(wire, big):
    make, there_and_back = wire
    ours = message(height=2, width=3, kinds=(8, 7, 3, 2), names="zxiy", big=big, gap=2, row_gap=5)
    fields = [make("sensor_msgs/msg/PointField", **vars(field)) for field in ours.fields]
    head = make("std_msgs/msg/Header", stamp=make("builtin_interfaces/msg/Time", sec=0, nanosec=0), frame_id="a")
    theirs = make("sensor_msgs/msg/PointCloud2", **{**vars(ours), "header": head, "fields": fields})
    back = there_and_back(theirs, "sensor_msgs/msg/PointCloud2")
    with np.errstate(invalid="ignore"):
        np.testing.assert_array_equal(from_pointcloud2(back), read_plainly(ours))


def test_detections_and_names_through_the_wire(wire, scene, result):
    make, there_and_back = wire
    sent = to_detections(scene, result, "map", 9, messages=make)
    back = there_and_back(sent, "vision_msgs/msg/Detection3DArray")
    assert [entry.results[0].hypothesis.class_id for entry in back.detections] == [
        entry.results[0].hypothesis.class_id for entry in to_detections(scene, result).detections
    ]
    assert back.detections[0].bbox == sent.detections[0].bbox
    info = there_and_back(to_label_info(["a", "ö"], messages=make), "vision_msgs/msg/LabelInfo")
    assert [entry.class_name for entry in info.class_map] == ["a", "ö"]
