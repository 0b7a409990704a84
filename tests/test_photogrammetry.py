"""Metashape's XML and RealityScan's CSV, as they write them: poses, lenses, chunks, and what has no pose."""

import numpy as np
import pytest
from capture_files import HEIGHT, WIDTH, make_world, same_camera, write_images, write_masks
from scenes import write_image, write_ply

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.capture import read_capture, read_poses
from og_pointcloud.formats.lenses import Lens
from og_pointcloud.formats.photogrammetry import find_photogrammetry, read_photogrammetry
from og_pointcloud.scene import Camera

SENSOR = """<sensor id="{id}" label="unknown" type="{type}"><resolution width="64" height="48"/>
<property name="layer_index" value="0"/>
<calibration type="{type}" class="initial"><resolution width="64" height="48"/><f>50</f></calibration>
<calibration type="{type}" class="adjusted"><resolution width="64" height="48"/>{terms}</calibration></sensor>"""
TERMS = "<f>72</f><cx>-1</cx><cy>1.5</cy><b1>-2</b1>"


def numbers(matrix):
    return " ".join(f"{value!r}" for value in np.asarray(matrix, float).ravel().tolist())


def transform_of(scale, rotation, translation):
    return (
        f'<transform><rotation locked="true">{numbers(rotation)}</rotation>'
        f"<translation>{numbers(translation)}</translation><scale>{scale!r}</scale></transform>"
    )


def metashape(world, *, sensors=None, in_chunk=None, extra="", component="", name="Chunk 1", cameras="", groups=None):
    """The XML of one chunk. in_chunk: world -> chunk of the points (3, 3) scaled rotation and (3,). groups: of each
    camera; None: the last one has one."""
    lines = []
    for index, (label, pose) in enumerate(zip(world.names, world.poses, strict=True)):
        to_world = np.linalg.inv(pose)
        if in_chunk is not None:
            scale, rotation, translation = in_chunk
            to_world[:3, 3] = rotation.T @ (to_world[:3, 3] - translation) / scale
            to_world[:3, :3] = rotation.T @ to_world[:3, :3]
        where = f'<transform>{numbers(to_world)}</transform><orientation>6</orientation><reference enabled="0"/>'
        keys = f'id="{index}" sensor_id="{index % len(sensors or [1])}" {component} label="{label}"'
        lines.append(f"<camera {keys}>{where}</camera>")
    of_camera = groups or [*[None] * (len(lines) - 1), "Group 1"]
    lines = [
        f'<group id="0" label="{group}" type="folder">{line}</group>' if group else line
        for group, line in zip(of_camera, lines, strict=True)
    ]
    made = sensors or [SENSOR.format(id=0, type="frame", terms=TERMS)]
    return (
        f'<chunk label="{name}" enabled="true"><sensors next_id="1">{"".join(made)}</sensors>'
        f'<cameras next_id="3" next_group_id="1">{"".join(lines)}{cameras}</cameras>{extra}</chunk>'
    )


def document(*chunks):
    return f'<?xml version="1.0" encoding="UTF-8"?>\n<document version="2.0.0">{"".join(chunks)}</document>'


def read(folder, text, name="cameras.xml"):
    (folder / name).write_text(text)
    file = find_photogrammetry(folder)
    assert file == folder / name
    return read_photogrammetry(file, lambda _: (WIDTH, HEIGHT))


def expected(world, intrinsics=(70.0, 72.0, 31.0, 25.5)):
    return [Camera(WIDTH, HEIGHT, *intrinsics, pose) for pose in world.poses]


def test_cameras_of_metashape(tmp_path):
    world = make_world()
    frames = read(tmp_path, document(metashape(world)))
    assert [image.path for image in frames.images] == world.names
    assert frames.dropped == ()
    for image, camera in zip(frames.images, expected(world), strict=True):
        assert same_camera(image.camera, camera, 1e-9)
        assert image.lens is None


@pytest.mark.parametrize("where", ["chunk", "component"])
def test_a_chunks_transform_takes_cameras_to_the_world(tmp_path, where):
    """Also to geocentric coordinates, six million meters away, and by a scale."""
    world = make_world(offset=(4e6, 3e5, 5e6))
    rotation = make_world(seed=5).poses[0][:3, :3]
    placed = (3.7, rotation, np.array([4e6, 3e5, 5e6]))
    transform = transform_of(*placed)
    if where == "component":
        extra = f'<components next_id="1"><component id="0" label="C">{transform}</component></components>'
        text = metashape(world, in_chunk=placed, extra=extra, component='component_id="0"')
    else:
        text = metashape(world, in_chunk=placed, extra=transform)
    frames = read(tmp_path, document(text))
    for image, camera in zip(frames.images, expected(world), strict=True):
        np.testing.assert_allclose(image.camera.center, camera.center, atol=1e-6)
        np.testing.assert_allclose(image.camera.world_to_camera[:3, :3], camera.world_to_camera[:3, :3], atol=1e-9)


@pytest.mark.parametrize("fisheye", ["fisheye", "equidistant_fisheye"])
def test_several_sensors_and_their_lenses(tmp_path, fisheye):
    """Metashape's p1 goes with r^2 + 2 x^2, which OpenCV calls p2; its k4 is of r^8."""
    terms = "<f>60</f><cx>0</cx><cy>0</cy><k1>0.1</k1><k2>0.2</k2><k3>0.3</k3><k4>0.4</k4><p1>0.01</p1><p2>0.02</p2>"
    sensors = [
        SENSOR.format(id=0, type="frame", terms=TERMS),
        SENSOR.format(id=1, type="frame", terms=terms),
        SENSOR.format(id=2, type=fisheye, terms=terms),
    ]
    plain, bent, wide = read(tmp_path, document(metashape(make_world(), sensors=sensors))).images
    assert (plain.camera.fx, plain.lens) == (70.0, None)
    assert bent.camera.fx == 60.0
    assert bent.lens == Lens("perspective", (0.1, 0.2, 0.02, 0.01, 0.3, 0, 0, 0, 0.4, 0))
    assert wide.lens == Lens("fisheye", (0.1, 0.2, 0.3, 0.4, 0.02, 0.01, 0, 0))
    x, y, r2 = 0.3, -0.2, 0.13
    radial = 1 + 0.1 * r2 + 0.2 * r2**2 + 0.3 * r2**3 + 0.4 * r2**4
    u, v = bent.lens.project(np.array([x, y, 1.0]))
    assert u == pytest.approx(x * radial + 0.01 * (r2 + 2 * x * x) + 2 * 0.02 * x * y)
    assert v == pytest.approx(y * radial + 0.02 * (r2 + 2 * y * y) + 2 * 0.01 * x * y)


def test_a_spherical_sensor(tmp_path):
    sensor = '<sensor id="0" type="spherical"><resolution width="128" height="64"/></sensor>'
    (tmp_path / "cameras.xml").write_text(document(metashape(make_world(count=1), sensors=[sensor])))
    assert [name.split("/")[1] for name in read_poses(tmp_path).names][:2] == ["front", "left"]


def test_photographs_without_a_pose_are_left_out_aloud(tmp_path):
    world = make_world()
    others = '<camera id="8" sensor_id="0" label="lost"/><camera id="9" sensor_id="0" label="off" enabled="false"/>'
    write_images(tmp_path, world.names)
    write_masks(tmp_path, world.names)
    write_ply(tmp_path / "points.ply", world.xyz, world.rgb)
    (tmp_path / "cameras.xml").write_text(document(metashape(world, cameras=others)))
    with pytest.warns(UserWarning, match=r"no finite pose for 1 of \d+ frames, which are left out, e.g. 'lost'"):
        scene = read_capture(tmp_path)
    assert [view.name for view in scene.views] == world.names
    assert all(view.image_rgb() is not None for view in scene.views)


def test_chunks_of_one_world_are_read_together_and_others_refused(tmp_path):
    first, second = make_world(), make_world(seed=1)
    second.names = [f"other_{name}" for name in second.names]
    placed = transform_of(1.0, np.eye(3), np.zeros(3))
    both = document(metashape(first, extra=placed), metashape(second, extra=placed, name="Chunk 2"))
    assert len(read(tmp_path, both).images) == 6
    with pytest.raises(SceneError, match=r"the chunks 'Chunk 1', 'Chunk 2' have no common world"):
        read(tmp_path, document(metashape(first), metashape(second, name="Chunk 2")))
    disabled = metashape(second, name="Chunk 2").replace('enabled="true"', 'enabled="false"')
    assert len(read(tmp_path, document(metashape(first), disabled)).images) == 3


@pytest.mark.parametrize("in_chunk", [False, True])
def test_components_without_a_common_world_are_refused(tmp_path, in_chunk):
    placed = transform_of(2.0, np.eye(3), [100.0, 0, 0])

    def components(first, second, enabled="true"):
        extra = f'<components><component id="0">{first}</component><component id="1">{second}</component></components>'
        text = metashape(make_world(), extra=extra + placed * in_chunk, component='component_id="0"')
        return document(text.replace('"0" label="frame_01"', f'"1" enabled="{enabled}" label="frame_01"'))

    for one, other in (("", ""), (placed, ""), ("", placed)):
        with pytest.raises(SceneError, match=r"2 components of the chunk 'Chunk 1' .*align or merge them, or disable"):
            read(tmp_path, components(one, other))
        assert len(read(tmp_path, components(one, other, "false")).images) == 2
    assert len(read(tmp_path, components(placed, placed)).images) == 3


def test_repeated_labels_are_told_apart_by_their_groups(tmp_path):
    world = make_world()
    world.names = ["a", "a", "b"]
    write_images(tmp_path, ["left/a", "right/a"])
    frames = read(tmp_path, document(metashape(world, groups=["left", "right", None])))
    assert [image.path for image in frames.images] == ["left/a", "right/a", "b"]
    assert read_poses(tmp_path).names == ("left/a", "right/a", "b")
    (tmp_path / "cameras.xml").write_text(document(metashape(world, groups=["left", "left", None])))
    with pytest.raises(SceneError, match=r"cameras.xml: two images have the path 'left/a'; expected unique ones"):
        read_poses(tmp_path)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("<f>72</f>", "<f>wide</f>"), r"camera 'frame_00': <f> contains 'wide'; expected 1 numbers"),
        (("<f>72</f>", "<f>72</f><b2>5</b2>"), r"skew b2 = 5.0; expected 0"),
        (("<f>72</f>", "<f>72</f><p3>3</p3>"), r"has the term p3 = 3.0"),
        (("<cx>", "<cx><x>"), r"not valid XML \(mismatched tag"),
        (('type="frame"', 'type="cylindrical"'), r"of type 'cylindrical'; expected frame, fisheye or spherical"),
        (("<document", "<!DOCTYPE a><document"), r"defines entities"),
        (("<resolution", "<size"), r"its sensor has no resolution"),
        (("</chunk>", "<transform><scale>0</scale></transform></chunk>"), r"its scale is 0; expected a number above 0"),
        (("</chunk>", "<transform><scale>-2</scale></transform></chunk>"), r"its scale is -2; expected"),
        (("<camera ", '<camera enabled="0" '), r"none of its 0 cameras has a pose"),
    ],
)
def test_what_cannot_be_read_of_metashape_is_said(tmp_path, change, said):
    with pytest.raises(SceneError, match=said):
        read(tmp_path, document(metashape(make_world())).replace(*change))


# RealityScan ------------------------------------------------------------------------------------------------------

HEADER = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"


def test_cameras_of_realityscan(tmp_path):
    """At angles of 0 down with north on top; heading turns to the east, pitch lifts to the horizon, roll tilts."""
    lines = [
        HEADER,
        "down.png,1,2,30,0,0,0,36,0,0,0,0,0,0,0,0",
        "east.png,1,2,30,90,90,0,27,0.9,-0.45,0,0,0,0,0,0",
        "north.png,1,2,30,0,90,0,36,0,0,0.1,0.2,0.3,0.4,0.01,0.02",
    ]
    down, east, north = read(tmp_path, "\ufeff" + "\n".join(lines) + "\n", "cameras.csv").images
    assert (down.path, down.lens) == ("down.png", None)
    assert same_camera(down.camera, Camera(64, 48, 64.0, 64.0, 32.0, 24.0, down.camera.world_to_camera))
    np.testing.assert_allclose(down.camera.center, [1, 2, 30])
    # Rows of a pose are the camera's right, down and forward in the world (x east, y north, z up).
    np.testing.assert_allclose(down.camera.world_to_camera[:3, :3], [[1, 0, 0], [0, -1, 0], [0, 0, -1]], atol=1e-12)
    np.testing.assert_allclose(east.camera.world_to_camera[:3, :3], [[0, -1, 0], [0, 0, -1], [1, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(north.camera.world_to_camera[:3, :3], [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-12)
    assert (east.camera.fx, east.camera.cx, east.camera.cy) == pytest.approx((48, 32 + 1.6, 24 - 0.8))
    assert north.lens == Lens("perspective", (0.1, 0.2, 0.01, 0.02, 0.3, 0, 0, 0, 0.4, 0))


def test_a_folder_of_realityscan_is_a_capture(tmp_path):
    for name, size in (("a", (48, 64)), ("b", (64, 48))):  # portrait and landscape in one project
        write_image(tmp_path / "images" / f"{name}.png", np.zeros((size[1], size[0], 3), np.uint8))
    line = ",0,0,5,0,0,0,36,0,0,0,0,0,0,0,0"
    (tmp_path / "project.csv").write_text(f"{HEADER}\na.png{line}\nC:\\photos\\b.png{line}\n")
    poses = read_poses(tmp_path)
    assert poses.names == ("a", "b")
    assert [(image.camera.width, image.camera.fx) for image in poses.images] == [(48, 64.0), (64, 64.0)]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (HEADER + "\na.png,x,2\n", r"line 2: x is 'x'; expected a number"),
        (HEADER + "\n,1,2\n", r"line 2: it names no image"),
        (HEADER + "\na.png,1,2,3,0,0,0,35\n", r"line 2: it ends before px: it is truncated"),
        ("#name,x,y\na.png,1,2\n", r"has no column 'alt'"),
        (HEADER + "\n", r"none of its 0 cameras has a pose"),
        (HEADER + "\na.png" + 15 * ",0" + "\n", r"line 2: camera intrinsics .* finite numbers, with fx and fy"),
    ],
)
def test_what_cannot_be_read_of_realityscan_is_said(tmp_path, text, said):
    with pytest.raises(SceneError, match=said):
        read(tmp_path, text, "cameras.csv")


def test_other_tables_are_left_alone(tmp_path):
    (tmp_path / "scores.csv").write_text("name,score\n")
    (tmp_path / "doc.xml").write_text("<html/>")
    (tmp_path / "empty.xml").write_bytes(b"")
    (tmp_path / "folder.xml").mkdir()
    assert find_photogrammetry(tmp_path) is None
    with pytest.raises(SceneError, match="is neither Metashape's XML"):
        read_photogrammetry(tmp_path / "doc.xml", lambda _: (1, 1))
