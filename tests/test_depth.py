"""Depth files as they are stored, the cloud that fusion makes of them, and what is said of those that do not fit."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scenes import CRATE, ROOM_SIZE, THING, camera, distance_to_surface, look, room_poses, write_depth, write_frames

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.depth import DepthFile, DepthFrame, DepthImage, resampled
from og_pointcloud.formats.faces import CUBE
from og_pointcloud.formats.fusion import (
    MAX_SLOPE,
    NOISE_TOLERANCE,
    _Voxels,
    doubtful_depth,
    fuse,
    on_surface,
    survey,
    to_world,
)
from og_pointcloud.formats.lenses import lens_of
from og_pointcloud.formats.poses import rigid

WIDTH, HEIGHT = ROOM_SIZE
POSE = room_poses()[0]


def read(path, **keys):
    return DepthFile(path, camera(POSE), **keys).read()


# Files ----------------------------------------------------------------------------------------------------------


def test_whole_numbers_are_millimeters_and_floats_are_lengths(tmp_path):
    depth, _ = look(POSE)
    write_depth(tmp_path / "a.png", depth)
    np.save(tmp_path / "b.npy", depth.astype(np.float32))
    np.save(tmp_path / "c.npy", np.round(depth * 1000).astype(np.uint16)[..., None])
    cv2.imwrite(str(tmp_path / "d.tiff"), depth.astype(np.float32))
    cv2.imwrite(str(tmp_path / "e.tif"), np.round(depth * 1000).astype(np.uint16))
    for name in ("a.png", "b.npy", "c.npy", "d.tiff", "e.tif"):
        np.testing.assert_allclose(read(tmp_path / name).depth, depth, atol=6e-4, err_msg=name)


def test_what_was_not_measured_is_zero(tmp_path):
    depth = np.full((HEIGHT, WIDTH), 2.0, np.float32)
    depth[0, :4] = np.nan, np.inf, -np.inf, -1
    np.save(tmp_path / "a.npy", depth)
    assert read(tmp_path / "a.npy").depth[0, :5].tolist() == [0, 0, 0, 0, 2]
    write_depth(tmp_path / "b.png", np.where(depth == 2, 2.0, 65.535))
    assert read(tmp_path / "b.png").depth[0, :5].tolist() == [0, 0, 0, 0, 2]  # the largest number of 16 bits


@pytest.mark.parametrize("kind", ["<u2", ">u2", "<i4", "<u4", "<u8"])
def test_the_largest_number_of_16_bits_is_no_depth_in_any_type(tmp_path, kind):
    stored = np.full((HEIGHT, WIDTH), 2000, kind)
    stored[0, :2] = 65535, 65534
    np.save(tmp_path / "a.npy", stored)
    assert read(tmp_path / "a.npy").depth[0, :3] == pytest.approx([0, 65.534, 2])


@pytest.mark.parametrize("kind", [np.float16, np.float32, np.float64])
def test_the_background_of_renderers_is_no_depth(tmp_path, kind):
    stored = np.full((HEIGHT, WIDTH), 2.0, kind)
    stored[0, :2] = 65504, np.float64(1e10).astype(np.float32) if kind != np.float16 else 65504
    stored[0, 2] = 65000
    np.save(tmp_path / "a.npy", stored)
    assert read(tmp_path / "a.npy").depth[0, :4] == pytest.approx([0, 0, float(kind(65000)), 2])


def test_a_unit_of_integers_does_not_scale_floats(tmp_path):
    np.save(tmp_path / "floats.npy", np.full((HEIGHT, WIDTH), 2.0, np.float32))
    np.save(tmp_path / "integers.npy", np.full((HEIGHT, WIDTH), 4000, np.uint16))
    for unit, floats in ((None, 2.0), (3.0, 6.0)):
        keys = {"unit": unit, "integer_unit": 0.0005}
        assert read(tmp_path / "floats.npy", **keys).depth[0, 0] == floats
        assert read(tmp_path / "integers.npy", **keys).depth[0, 0] == pytest.approx(2.0)


def test_a_smaller_file_scales_its_camera_and_another_shape_is_refused(tmp_path):
    write_depth(tmp_path / "small.png", np.full((HEIGHT // 2, WIDTH // 2), 1.5))
    image = read(tmp_path / "small.png", unit=0.002)
    assert (image.camera.width, image.camera.fx) == (WIDTH // 2, camera(POSE).fx / 2)
    assert image.depth[3, 3] == pytest.approx(3.0)
    write_depth(tmp_path / "wide.png", np.ones((HEIGHT // 2, WIDTH)))
    with pytest.raises(SceneError, match=f"{WIDTH}x{HEIGHT // 2} pixels, its camera {WIDTH}x{HEIGHT}"):
        read(tmp_path / "wide.png")


def test_a_distorted_depth_image_becomes_a_pinholes(tmp_path):
    depth = np.full((HEIGHT, WIDTH), 2.0)
    depth[:, WIDTH // 4 :] = 3.0
    write_depth(tmp_path / "a.png", depth)
    plain = read(tmp_path / "a.png")
    bent = read(tmp_path / "a.png", lens=lens_of("perspective", {"k1": 0.3}))
    edge = [int(np.argmax(image.depth[len(image.depth) // 2] > 2.5)) for image in (plain, bent)]
    # r_d = r (1 + 0.3 r^2): the distorted edge at 40 px from the middle stands at a smaller radius in the pinhole.
    radius = np.roots([0.3, 0, 1, -(WIDTH / 4) / camera(POSE).fx])
    radius = float(radius[np.isreal(radius)].real[0])
    assert edge[0] == WIDTH // 4
    assert abs(edge[1] - (bent.camera.cx - radius * camera(POSE).fx)) <= 1


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.png", b"", "cannot be decoded"),
        ("a.npy", b"\x93NUMPY", "cannot be read as a .npy"),
        ("a.jpg", b"x", "expected a depth image"),
        ("a.tiff", b"II*\0", "cannot be decoded"),
    ],
)
def test_damaged_files_name_the_cure(tmp_path, name, content, said):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(SceneError, match=said):
        read(tmp_path / name)


def test_pictures_of_depth_and_objects_are_refused(tmp_path):
    cv2.imwrite(str(tmp_path / "grey.png"), np.zeros((HEIGHT, WIDTH), np.uint8))
    with pytest.raises(SceneError, match="16-bit gray"):
        read(tmp_path / "grey.png")
    np.save(tmp_path / "o.npy", np.array([{"a": 1}], object), allow_pickle=True)
    with pytest.raises(SceneError, match="cannot be read"):
        read(tmp_path / "o.npy")
    np.save(tmp_path / "flat.npy", np.zeros(5, np.float32))
    with pytest.raises(SceneError, match=r"float32 \(5,\)"):
        read(tmp_path / "flat.npy")
    with pytest.raises(SceneError, match="is not a file"):
        read(tmp_path / "gone.png")


def test_resampling_picks_the_pixel_a_ray_falls_into():
    source, target = camera(POSE), camera(POSE, (100, 90), (70.0, 65.0, 41.0, 48.0))
    values = np.arange(HEIGHT * WIDTH, dtype=np.float32).reshape(HEIGHT, WIDTH) + 1
    picked = resampled(values, source, target)
    for row, column in [(0, 0), (10, 90), (48, 41), (89, 99), (60, 3)]:
        x, y = (column + 0.5 - 41) / 70, (row + 0.5 - 48) / 65
        u, v = int(np.floor(x * source.fx + source.cx)), int(np.floor(y * source.fy + source.cy))
        inside = 0 <= u < WIDTH and 0 <= v < HEIGHT
        assert picked[row, column] == (values[v, u] if inside else 0)


# Fusion ---------------------------------------------------------------------------------------------------------


def test_a_pixel_of_the_cloud_lies_where_it_was_seen():
    depth, _ = look(POSE)
    xyz = to_world(DepthImage(depth.astype(np.float32), camera(POSE)), np.ones(depth.shape, bool))
    assert distance_to_surface(xyz).max() < 1e-6
    x, y = (7 + 0.5 - 80) / 130, (3 + 0.5 - 60) / 130
    np.testing.assert_allclose(
        xyz[3 * WIDTH + 7], POSE[:3, :3] @ np.array([x, y, 1]) * depth[3, 7] + POSE[:3, 3], atol=1e-6
    )


def test_the_fused_cloud_lies_on_the_surface_and_covers_it(tmp_path):
    frames = write_frames(tmp_path)
    fused = fuse(frames)
    voxel = fused.survey.voxel
    xyz = fused.points.xyz_world
    assert distance_to_surface(xyz).max() < voxel / 2
    seen = np.concatenate(
        [to_world(image, image.depth > 0)[::37] for image in (frame.depth.read() for frame in frames)]
    )
    missing = [np.linalg.norm(xyz - point, axis=1).min() > 2 * voxel for point in seen[::20]]
    assert np.mean(missing) < 0.02
    inner = (np.abs(xyz - CRATE.mean(axis=0)) < (CRATE[1] - CRATE[0]) / 2 + 1e-3).all(axis=1) & (xyz[:, 2] > voxel)
    assert (np.abs(fused.points.rgb[inner].astype(int) - THING).max(axis=1) < 8).mean() > 0.9


def test_noise_makes_one_layer_and_flying_pixels_none(tmp_path):
    rng = np.random.default_rng(0)

    def spoil(_, depth):
        near, far = cv2.erode(depth, np.ones((3, 3))), cv2.dilate(depth, np.ones((3, 3)))
        flying = (far > 1.05 * near) & (rng.uniform(size=depth.shape) < 0.5)
        return np.where(
            flying, near + rng.uniform(size=depth.shape) * (far - near), depth + rng.normal(0, 0.01, depth.shape)
        )

    fused = fuse(write_frames(tmp_path, spoiled=spoil))
    off = distance_to_surface(fused.points.xyz_world)
    assert 0.006 < fused.survey.noise < 0.02  # 0.01, and what slanted pixels add
    assert np.median(off) < 0.006
    assert (off > 3 * fused.survey.voxel).mean() < 0.002
    assert fused.refused > 0


def test_a_ghost_that_two_views_saw_and_more_looked_through_is_refused(tmp_path):
    def haunted(index, depth):
        depth = depth.copy()
        if index == 0:
            depth[50:80, 60:100] = 0.6  # in the air, before the crate
        return depth

    frames = write_frames(tmp_path, spoiled=haunted)
    off = distance_to_surface(fuse([frames[0], *frames]).points.xyz_world)
    assert off.max() < 0.1
    alone = distance_to_surface(fuse([frames[0], frames[0]]).points.xyz_world)
    assert (alone > 0.1).sum() > 8  # nobody else was there to say otherwise


def test_large_map_offsets_cost_nothing(tmp_path):
    offset = np.array([4.5e6, -1.2e6, 3e5])
    near = fuse(write_frames(tmp_path / "near", 4))
    far = fuse(write_frames(tmp_path / "far", 4, offset))
    assert distance_to_surface(far.points.xyz_world - offset).max() < far.survey.voxel / 2
    assert abs(len(far.points) - len(near.points)) < 0.02 * len(near.points)


def test_where_a_simulator_cuts_off_its_range_there_is_no_surface(tmp_path):
    def cut(depth):
        return np.minimum(depth, np.quantile(look(POSE)[0], 0.8))

    fused = fuse(write_frames(tmp_path / "cut", spoiled=lambda _, depth: cut(depth)))
    assert fused.survey.range_end == pytest.approx(np.quantile(look(POSE)[0], 0.8), abs=1e-3)
    assert distance_to_surface(fused.points.xyz_world).max() < fused.survey.voxel / 2
    # A floor that is seen from one height is as far in all views, and it is there; so are walls around a camera.
    plane = np.where(np.hypot(*np.mgrid[-60:60, -80:80]) < 20, 1.5, 2.0).astype(np.float32)
    np.save(tmp_path / "plane.npy", plane)
    along_a_floor = [rigid(np.eye(3), np.array([x, 0.0, 0.0])) for x in (0.0, 0.1, 0.2, 0.3)]
    for poses in (along_a_floor, [rigid(turn, np.zeros(3)) for turn in CUBE.values()]):
        frames = [DepthFrame(str(k), DepthFile(tmp_path / "plane.npy", camera(at))) for k, at in enumerate(poses)]
        assert survey(frames).range_end == np.inf


def test_one_view_is_enough(tmp_path):
    fused = fuse(write_frames(tmp_path, 1))
    assert len(fused.points) > 500
    assert distance_to_surface(fused.points.xyz_world).max() < fused.survey.voxel / 2
    assert fused.survey.noise == 0


def test_order_of_frames_and_meters_or_millimeters_do_not_matter(tmp_path):
    frames = write_frames(tmp_path, 6)
    fused = fuse(frames)
    turned = fuse(frames[::-1])
    np.testing.assert_allclose(np.sort(turned.points.xyz_world, 0), np.sort(fused.points.xyz_world, 0), atol=1e-5)

    def in_millimeters(frame):
        pose = frame.depth.camera.world_to_camera.copy()
        pose[:3, 3] *= 1000
        moved = replace(frame.depth.camera, world_to_camera=pose)
        return replace(frame, depth=replace(frame.depth, camera=moved, unit=1.0))

    large = fuse([in_millimeters(frame) for frame in frames])
    assert large.survey.voxel == pytest.approx(1000 * fused.survey.voxel, rel=1e-4)
    assert abs(len(large.points) - len(fused.points)) < 0.01 * len(fused.points)


def test_empty_images_are_named_and_all_empty_ones_refused(tmp_path):
    frames = write_frames(tmp_path, 4, spoiled=lambda index, depth: depth * (index != 2))
    assert fuse(frames).empty == ("view2",)
    nothing = write_frames(tmp_path / "no", 3, spoiled=lambda _, depth: depth * 0)
    with pytest.raises(SceneError, match="none of the 3 depth images has a measured pixel"):
        fuse(nothing)


def test_a_view_far_away_is_named(tmp_path):
    frames = write_frames(tmp_path, 3)
    pose = room_poses(3)[1].copy()
    pose[0, 3] = 1e7
    frames[1] = replace(frames[1], name="lost", depth=replace(frames[1].depth, camera=camera(pose)))
    with pytest.raises(SceneError, match="view 'lost' has points 1e\\+07 from the middle"):
        fuse(frames)


def test_without_images_there_are_no_colors(tmp_path):
    assert fuse(write_frames(tmp_path, 2, colors=False)).points.rgb is None


def test_a_pixel_between_two_surfaces_is_none_and_a_slanted_surface_is_one():
    depth = np.full((5, 7), 2.0, np.float32)
    depth[:, 4:] = 3.0
    depth[2, 3] = 2.5  # between
    kept = on_surface(DepthImage(depth, camera(POSE, (7, 5), (100.0, 100.0, 3.5, 2.5))), 0.0)
    assert not kept[2, 3]
    assert kept.sum() == 34
    slanted = np.broadcast_to(2 + 0.1 * np.arange(7, dtype=np.float32), (5, 7))  # 79 degrees: 0.1 a pixel of 0.02
    assert on_surface(DepthImage(slanted, camera(POSE, (7, 5), (100.0, 100.0, 3.5, 2.5))), 0.0)[:, 1:].all()


@pytest.mark.parametrize(("step", "slanted"), [(1, False), (1, True), (2, True)])
@pytest.mark.parametrize("seed", range(4))
def test_readings_on_a_surface_are_as_in_words(seed, step, slanted):
    random = np.random.default_rng(seed)
    inverse = 0.2 + 0.08 * np.arange(12)[:, None] + random.normal(0, 0.004, (12, 12))
    inverse = inverse.T if seed % 2 else inverse
    depth = np.where(random.random((12, 12)) < 0.05, 0, 1 / inverse).astype(np.float32)
    noise = 0.002

    def joined(line, k, focal):
        near = [line[j] for j in (k - 1, k + 1) if 0 <= j < len(line) and line[j] > 0]
        if any(abs(z - line[k]) <= min(z, line[k]) * MAX_SLOPE / focal + NOISE_TOLERANCE * noise for z in near):
            return True
        runs = (line[j : j + 5] for j in range(k - 4, k + 1) if 0 <= j <= len(line) - 5)
        slopes = [np.diff(1 / run) for run in runs if (run > 0).all()]
        return slanted and any(np.ptp(slope) <= 0.25 * np.abs(slope).min() for slope in slopes)

    expected = np.zeros(depth.shape, bool)
    for row, column in np.argwhere(depth > 0):
        if row % step == step // 2 == column % step:
            across = joined(depth[row].astype(float), column, 90.0)
            expected[row, column] = across and joined(depth[:, column].astype(float), row, 70.0)
    assert 0 < expected.sum() < np.count_nonzero(depth[step // 2 :: step, step // 2 :: step])
    image = DepthImage(depth, camera(POSE, (12, 12), (90.0, 70.0, 6.0, 6.0)))
    np.testing.assert_array_equal(on_surface(image, noise, step, slanted=slanted), expected)


def test_images_of_one_row_or_column_are_surfaces_along_the_other():
    depth = np.array([[2.0, 2.01, 2.5, 3.0]], np.float32)
    row = on_surface(DepthImage(depth, camera(POSE, (4, 1), (100.0, 100.0, 2.0, 0.5))), 0.0)
    column = on_surface(DepthImage(depth.T, camera(POSE, (1, 4), (100.0, 100.0, 0.5, 2.0))), 0.0)
    assert row[0].tolist() == column[:, 0].tolist() == [True, True, False, False]


def test_voxels_are_the_means_of_their_points_however_often_they_are_added_to():
    rng = np.random.default_rng(0)
    xyz, rgb = rng.normal(size=(4000, 3)), rng.integers(0, 256, (4000, 3))
    voxels = _Voxels(0.25)
    for rows in np.array_split(rng.permutation(4000), 9):
        voxels.add(xyz[rows], rgb[rows], "points")
    cells, cell = np.unique(np.floor(xyz / 0.25), axis=0, return_inverse=True)
    means, colors = voxels.means()
    assert len(means) == len(cells)
    for k in range(len(cells)):
        np.testing.assert_allclose(means[k], xyz[cell.ravel() == k].mean(axis=0), atol=1e-12)
        np.testing.assert_allclose(colors[k], rgb[cell.ravel() == k].mean(axis=0), atol=1e-12)
    assert len(_Voxels(1.0).means()[0]) == 0


# Doubts ---------------------------------------------------------------------------------------------------------


def test_depth_that_fits_raises_no_doubt(tmp_path):
    assert doubtful_depth(write_frames(tmp_path)) is None


def test_a_wrong_unit_is_named(tmp_path):
    frames = [replace(frame, depth=replace(frame.depth, unit=1.0)) for frame in write_frames(tmp_path)]
    assert "multiplied by 0.001" in doubtful_depth(frames)


def test_survey_of_exact_depth_knows_the_pixel(tmp_path):
    found = survey(write_frames(tmp_path))
    assert found.footprint == pytest.approx(found.depth / camera(POSE).fx, rel=1e-3)
    assert found.noise < found.footprint
