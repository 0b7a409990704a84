"""Lenses against COLMAP's own projection and OpenCV's; faces against where a point must appear."""

from functools import partial

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.faces import faces
from og_pointcloud.formats.lenses import SPHERICAL, Lens, lens_of, spherical_camera, widest
from og_pointcloud.formats.poses import rigid
from og_pointcloud.scene import NOT_SEEN, Camera, View

WIDTH, HEIGHT = 320, 240
CAMERA = Camera(WIDTH, HEIGHT, 260.0, 255.0, 165.0, 117.0, np.eye(4))
LENSES = {
    "barrel": ("perspective", {"k1": -0.2, "k2": 0.04}),
    "pincushion": ("perspective", {"k1": 0.15}),
    "opencv": ("perspective", {"k1": -0.2, "k2": 0.05, "p1": 0.004, "p2": -0.006}),
    "rational": ("perspective", {"k1": 0.3, "k2": 0.05, "k3": 0.01, "k4": 0.5, "k5": 0.1, "p1": 0.002, "k6": 0.02}),
    "fisheye": ("fisheye", {"k1": 0.03, "k2": -0.01, "k3": 0.002}),
    "equidistant": ("fisheye", {}),
    "thin prism": ("fisheye", {"k1": 0.02, "p1": 0.003, "p2": -0.002, "sx1": 0.004, "sy1": -0.003}),
    "fov": ("fov", {"omega": 0.9}),
    "division": ("division", {"k": -0.2}),
    "extended": ("extended", {"alpha": 0.6, "beta": 1.1}),
    "unified": ("perspective", {"xi": 0.3, "k1": -0.1}),
}
COLMAP = {
    "opencv": ("FULL_OPENCV", "k1 k2 p1 p2 k3 k4 k5 k6"),
    "rational": ("FULL_OPENCV", "k1 k2 p1 p2 k3 k4 k5 k6"),
    "fisheye": ("OPENCV_FISHEYE", "k1 k2 k3 k4"),
    "thin prism": ("THIN_PRISM_FISHEYE", "k1 k2 p1 p2 k3 k4 sx1 sy1"),
    "fov": ("FOV", "omega"),
    "division": ("DIVISION", "k"),
    "extended": ("EUCM", "alpha beta"),
}


def lens(name) -> Lens:
    return lens_of(*LENSES[name])


def pixels(camera, made, points):
    u, v = made.project(points)
    return np.stack([u * camera.fx + camera.cx, v * camera.fy + camera.cy], axis=-1)


def rays(widest_angle, count=500, seed=0):
    rng = np.random.default_rng(seed)
    theta, phi = rng.uniform(0, widest_angle, count), rng.uniform(0, 2 * np.pi, count)
    directions = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=1)
    return directions * rng.uniform(0.1, 9, (count, 1))


@pytest.mark.parametrize("name", COLMAP)
def test_rays_meet_the_image_where_colmap_says(name):
    pycolmap = pytest.importorskip("pycolmap")
    model, terms = COLMAP[name]
    values = [LENSES[name][1].get(term, 0.0) for term in terms.split()]
    parameters = [CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy, *values]
    theirs = pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=parameters)
    points = rays(0.7)
    np.testing.assert_allclose(pixels(CAMERA, lens(name), points), theirs.img_from_cam(points), atol=1e-8)


def test_rays_meet_a_panorama_where_colmap_says():
    pycolmap = pytest.importorskip("pycolmap")
    theirs = pycolmap.Camera(model="EQUIRECTANGULAR", width=400, height=200, params=[400, 200])
    points = rays(3.1)
    ours = pixels(spherical_camera(400, 200, np.eye(4)), SPHERICAL, points)
    np.testing.assert_allclose(ours, theirs.img_from_cam(points), atol=1e-8)


def test_the_unified_model_is_the_extended_one():
    """Of xi, with alpha = xi / (1 + xi), beta 1, and focal lengths (1 + xi) times as long: Usenko et al. 2018."""
    unified, extended = lens_of("perspective", {"xi": 1.5}), lens_of("extended", {"alpha": 0.6, "beta": 1.0})
    points = rays(1.6)
    np.testing.assert_allclose(np.multiply(unified.project(points), 2.5), extended.project(points), rtol=1e-12)


def test_a_lens_sees_no_farther_than_its_radius_grows():
    equidistant, turning = lens_of("fisheye", {}), lens_of("fisheye", {"k1": -0.1})
    assert widest(equidistant) > 3.1
    # theta - 0.1 theta^3 is largest at sqrt(1 / 0.3).
    assert widest(turning) == pytest.approx(np.sqrt(1 / 0.3), abs=1e-3)
    assert widest(lens("barrel")) <= np.pi / 2
    assert np.isnan(turning.project(rays(0.5) * [1, 1, -1])).all()


# Views ----------------------------------------------------------------------------------------------------------


def one_face(camera, made):
    (face,) = faces(camera, made)
    assert face.name == ""
    return face


@pytest.mark.parametrize("name", LENSES)
def test_a_mask_painted_through_the_lens_is_found_at_the_pinhole_pixel(name):
    """Points all over the image as it is, its rim too: each one's mask lies where the view's camera sees the point."""
    made = lens(name)
    face = one_face(CAMERA, made)
    v, u = (axis.ravel() for axis in np.mgrid[4 : face.camera.height - 4 : 13, 4 : face.camera.width - 4 : 13] + 0.3)
    depth = np.linspace(1.0, 9.0, len(u))
    camera = face.camera
    points = np.stack([(u - camera.cx) / camera.fx * depth, (v - camera.cy) / camera.fy * depth, depth], axis=1)
    at = pixels(CAMERA, made, points)
    seen = ((at > 3) & (at < [WIDTH - 3, HEIGHT - 3])).all(axis=1)
    assert seen.sum() > 150
    painted = np.full((HEIGHT, WIDTH), -1, np.int32)
    for row in np.flatnonzero(seen):
        j, i = np.floor(at[row]).astype(int)
        painted[i - 1 : i + 2, j - 1 : j + 2] = row
    view = View("v", camera, partial(face.mask_ids, painted), np.ones((len(points), 4), np.float32))
    found = view.mask_map()
    np.testing.assert_array_equal(found[v.astype(int)[seen], u.astype(int)[seen]], np.flatnonzero(seen))
    assert set(np.unique(found)) <= {NOT_SEEN, -1, *np.flatnonzero(seen)}  # nearest never mixes two


@pytest.mark.parametrize("name", LENSES)
def test_nothing_of_the_image_is_cropped(name):
    """Every pixel of the image as it is, but a few at the very rim, appears in the view."""
    face = one_face(CAMERA, lens(name))
    ids = np.arange(WIDTH * HEIGHT, dtype=np.int32).reshape(HEIGHT, WIDTH)
    blocks = ids // WIDTH // 8 * (WIDTH // 8) + ids % WIDTH // 8
    assert len(set(np.unique(face.mask_ids(blocks))) - {NOT_SEEN}) == (WIDTH // 8) * (HEIGHT // 8)


@pytest.mark.parametrize("name", LENSES)
def test_a_mark_in_the_image_moves_to_the_pinhole_pixel(name):
    made, face = lens(name), one_face(CAMERA, lens(name))
    point = np.array([[0.21, -0.13, 1.0]])
    (u, v), image = pixels(CAMERA, made, point)[0], np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    image[:] = np.round(250 * np.exp(-((x - u) ** 2 + (y - v) ** 2) / 18.0))[..., None]
    out = face.image(image)[..., 0].astype(float)
    assert out.shape == (face.camera.height, face.camera.width)
    y, x = np.mgrid[: out.shape[0], : out.shape[1]] + 0.5
    weight = np.where(out > 25, out, 0)
    centroid = np.array([(weight * x).sum(), (weight * y).sum()]) / weight.sum()
    assert np.abs(centroid - face.camera.project(point)[0]).max() < 0.25


@pytest.mark.parametrize("k1", [1e-9, -1e-9])
def test_hardly_any_distortion_changes_no_pixel(k1):
    made = lens_of("perspective", {"k1": k1})
    face, ids = one_face(CAMERA, made), np.arange(WIDTH * HEIGHT, dtype=np.int32).reshape(HEIGHT, WIDTH)
    np.testing.assert_array_equal(face.mask_ids(ids), ids)
    assert (face.camera.fx, face.camera.cx, face.camera.cy) == (CAMERA.fx, CAMERA.cx, CAMERA.cy)


def test_a_polynomial_that_turns_back_shows_nothing_twice():
    """1 - r^2 is largest at r = 0.577: beyond that the same content would come again, mirrored."""
    wide = Camera(WIDTH, HEIGHT, 120.0, 120.0, 160.0, 120.0, np.eye(4))
    made = lens_of("perspective", {"k1": -1.0})
    face = one_face(wide, made)
    ids = face.mask_ids(np.zeros((HEIGHT, WIDTH), np.int32))
    y, x = np.mgrid[: ids.shape[0], : ids.shape[1]] + 0.5
    radius = np.hypot((x - face.camera.cx) / 120, (y - face.camera.cy) / 120)
    assert (ids[radius < 0.57] == 0).all()
    assert (ids[radius > 0.585] == NOT_SEEN).all()


def test_a_halved_image_is_split_alike():
    whole = one_face(CAMERA, lens("opencv"))
    half = whole.of_whole_size(WIDTH // 2, HEIGHT // 2)
    column = np.tile(np.arange(WIDTH, dtype=np.float32) + 0.5, (HEIGHT, 1))
    full = whole.depths(column)
    small = half.depths(2 * column[: HEIGHT // 2, : WIDTH // 2])
    rows = np.arange(small.shape[0]) * full.shape[0] // small.shape[0]
    columns = np.arange(small.shape[1]) * full.shape[1] // small.shape[1]
    picked = full[np.ix_(rows, columns)]
    both = (picked > 0) & (small > 0)
    assert both.mean() > 0.8
    assert np.abs(picked - small)[both].max() <= 3
    again = half.of_size(whole.camera.width, whole.camera.height)
    for back, before in ((again.camera, whole.camera), (again.whole, whole.whole)):
        assert (back.width, back.height, back.intrinsics) == (before.width, before.height, before.intrinsics)


@pytest.mark.parametrize("cx", [320.0, -900.0])
def test_a_long_lens_is_one_view_to_its_rim(cx):
    """A hundredth of a degree a pixel; also of a cut-out beside the axis."""
    camera = Camera(640, 480, 60000.0, 60000.0, cx, 240.0, np.eye(4))
    made = lens_of("perspective", {"k1": 0.5})
    face = one_face(camera, made)
    assert (face.camera.width, face.camera.height) == pytest.approx((640, 480), abs=1)
    blocks = np.arange(640 * 480, dtype=np.int32).reshape(480, 640) // 40
    assert len(np.unique(face.mask_ids(blocks))) >= 640 * 480 // 40 - 12  # but for a row


def test_a_lens_that_looks_elsewhere_is_refused():
    with pytest.raises(SceneError, match="sees nothing in front of it"):
        faces(Camera(64, 48, 60.0, 60.0, 4000.0, 24.0, np.eye(4)), lens("barrel"))


def test_named_terms():
    assert lens_of("perspective", {"k1": 0.0, "p1": 0.0}) is None
    assert lens_of("fisheye", {}) is not None
    with pytest.raises(SceneError, match=r"has the term omega = 0\.9; expected only k1"):
        lens_of("perspective", {"omega": 0.9})
    with pytest.raises(SceneError, match="expected finite numbers"):
        lens_of("perspective", {"k1": np.nan})


def test_a_mask_of_another_size_is_refused():
    with pytest.raises(SceneError, match=r"the map is \(10, 10\); expected the camera's \(240, 320\)"):
        one_face(CAMERA, lens("barrel")).mask_ids(np.zeros((10, 10), np.int32))


# Cubes ----------------------------------------------------------------------------------------------------------

FISHEYE = Camera(400, 400, 127.0, 127.0, 200.0, 200.0, np.eye(4))
"""Equidistant: its circle of 90 degrees has radius 199.5, its corners look backwards."""


def pose():
    return rigid(Rotation.random(rng=np.random.default_rng(3)).as_matrix(), np.array([0.3, -0.2, 0.9]))


def wide_images():
    equidistant = lens_of("fisheye", {})
    bent = lens_of("fisheye", {"k1": -0.01, "k2": 0.002})
    scan = Camera(876, 584, 395.0, 395.0, 436.0, 292.0, pose())
    return {
        "spherical": (spherical_camera(800, 400, pose()), SPHERICAL),
        "circle": (Camera(400, 400, 127.0, 127.0, 200.0, 200.0, pose()), equidistant),
        "dslr": (scan, bent),
        "beyond 180": (Camera(300, 300, 80.0, 80.0, 150.0, 150.0, pose()), equidistant),
    }


@pytest.mark.parametrize("name", wide_images())
def test_each_ray_that_the_lens_saw_is_in_exactly_one_face_at_its_pixel(name):
    camera, made = wide_images()[name]
    split = faces(camera, made)
    assert len({face.name for face in split}) == len(split) > 1
    in_camera = rays(np.pi, 4000, seed=1)
    world = (in_camera - camera.world_to_camera[:3, 3]) @ camera.world_to_camera[:3, :3]
    at = pixels(camera, made, in_camera)
    seen = ((at > 2) & (at < [camera.width - 2, camera.height - 2])).all(axis=1)
    if name in ("circle", "beyond 180"):  # the corners are black
        seen &= np.hypot(*(at - camera.width / 2).T) < camera.width / 2 - 2
    assert seen.sum() > 1000
    numbers = np.arange(camera.width * camera.height, dtype=np.int32).reshape(camera.height, camera.width)
    shown = np.zeros(len(world), int)
    for face in split:
        uv, _ = face.camera.project(world)
        inside = face.camera.shows(uv)
        column, row = np.floor(uv[inside]).astype(int).T
        number = face.mask_ids(numbers)[row, column]
        found = number >= 0
        place = np.stack([number % camera.width, number // camera.width], axis=1) + 0.5
        apart = np.abs(place - at[inside])
        apart[:, 0] = np.minimum(apart[:, 0], np.where(made.wraps, camera.width - apart[:, 0], apart[:, 0]))
        # A pixel of a face is hardly wider than the image's; the ray meets it up to half of that beside its center.
        near_pole = np.abs(in_camera[inside, 1]) > 0.7 * np.linalg.norm(in_camera[inside], axis=1)
        assert np.percentile(apart[found & seen[inside] & ~(near_pole & made.wraps)], 99) < 1.1
        shown[np.flatnonzero(inside)[found]] += 1
    assert (shown[seen] == 1).mean() > 0.985  # slivers of a face that would be no view, and the faces' common borders
    assert shown.max() <= 2


def test_a_face_is_as_sharp_as_the_panorama():
    split = faces(spherical_camera(800, 400, np.eye(4)), SPHERICAL)
    assert [face.name for face in split] == ["front", "left", "right", "up", "down", "back"]
    columns = np.broadcast_to(np.arange(800, dtype=np.int32), (400, 800))
    for face in split[:3]:
        middle = face.mask_ids(columns)[face.camera.height // 2]
        assert (np.diff(middle) % 800).max() == 1, "a column of the panorama is passed over"


def test_faces_look_where_they_are_called():
    split = {face.name: face.camera for face in faces(spherical_camera(800, 400, np.eye(4)), SPHERICAL)}
    directions = {"front": (0, 0, 1), "left": (-1, 0, 0), "right": (1, 0, 0), "up": (0, -1, 0), "down": (0, 1, 0)}
    for name, direction in (directions | {"back": (0, 0, -1)}).items():
        uv, depth = split[name].project(np.array([direction], float))
        assert depth[0] == pytest.approx(1)
        np.testing.assert_allclose(uv, [[400 / np.pi, 400 / np.pi]])


def test_only_what_the_lens_saw_becomes_views():
    equidistant = lens_of("fisheye", {})
    split = {face.name: face.camera for face in faces(FISHEYE, equidistant)}
    assert list(split) == ["front", "left", "right", "up", "down"]
    assert split["front"].width == pytest.approx(2 * FISHEYE.fx, abs=1)
    assert split["left"].width < 0.8 * split["front"].width
    painted = np.zeros((400, 400), np.int32)
    for face in faces(FISHEYE, equidistant):
        ids = face.mask_ids(painted)
        assert (ids != NOT_SEEN).any(axis=0).all()
        assert (ids != NOT_SEEN).any(axis=1).all()


def test_a_panorama_that_is_no_sphere_is_refused():
    with pytest.raises(SceneError, match="is 400x300; expected twice as wide as high"):
        spherical_camera(400, 300, np.eye(4))


def test_colors_of_a_panorama_run_on_over_its_border():
    """Red is the cosine of the longitude, so the back face is dark red, without a seam."""
    longitude = (np.arange(800) + 0.5) / 800 * 2 * np.pi - np.pi
    image = np.zeros((400, 800, 3), np.uint8)
    image[..., 0] = np.round(128 + 100 * np.cos(longitude))
    back = next(face for face in faces(spherical_camera(800, 400, np.eye(4)), SPHERICAL) if face.name == "back")
    red = back.image(image)[..., 0].astype(int)
    assert red.max() < 70
    assert np.abs(np.diff(red, axis=1)).max() <= 2


def test_opencv_agrees_on_its_fisheye():
    made = lens("fisheye")
    matrix = np.array([[CAMERA.fx, 0, CAMERA.cx], [0, CAMERA.fy, CAMERA.cy], [0, 0, 1]])
    points = rays(1.2)
    theirs = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), matrix, np.array(made.terms[:4]))[0]
    np.testing.assert_allclose(pixels(CAMERA, made, points), theirs[:, 0], atol=1e-8)
