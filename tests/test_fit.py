"""From a scene to a labelled cloud: boxes on a table, seen and masked exactly, so that the truth is known."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import pytest
from numba.core.event import trigger_event
from numpy.typing import NDArray
from visits import DIRECTIONS, SPACE, Thing, cameras, cast, scene, surface

from og_pointcloud.cloud import BACKGROUND, LabelledCloud
from og_pointcloud.errors import OgPointcloudError, SceneError
from og_pointcloud.fitting.fit import fit, prepare
from og_pointcloud.journal import Journal, LeftOut
from og_pointcloud.kernels import timed_compiling
from og_pointcloud.scene import Camera, Points, Scene, View
from og_pointcloud.settings import (
    CodebookSettings,
    FeatureSettings,
    FitSettings,
    GeometrySettings,
    GroupingSettings,
    MatchingSettings,
    MembershipSettings,
    PaperSettings,
)

WIDTH, HEIGHT = 96, 72
THINGS = [
    Thing((-1.0, -0.9, 0.0), (0.7, 0.6, 0.5), (200, 40, 40), 1),
    Thing((0.2, -1.0, 0.0), (0.7, 0.5, 0.4), (40, 160, 40), 2),
    Thing((-0.9, 0.3, 0.0), (0.6, 0.7, 0.6), (40, 60, 200), 3),
    Thing((0.4, 0.3, 0.0), (0.5, 0.5, 0.5), (210, 190, 40), 4),
]
BOXES = TABLE = len(THINGS)
SPACING = 0.06


@dataclass(frozen=True)
class Known:
    """scene, and the box of each point, TABLE on the table, which has no mask."""

    scene: Scene
    truth: NDArray[np.int32]


@lru_cache
def boxes_on_a_table(view_count: int = 8, *, photographs: bool = False) -> Known:
    """The checks of a fit look longer at photographs than the fit itself takes: most tests do without."""
    views, owner = cameras(view_count, size=(WIDTH, HEIGHT)), surface(THINGS, spacing=SPACING)[1]
    made = scene(THINGS, views, spacing=SPACING, floor=False, photographs=photographs)
    return Known(made, np.where(owner < 0, TABLE, owner))


def share_right(cloud: LabelledCloud, truth: NDArray[np.int_]) -> float:
    """Share of points with the right state: the instance that holds most of its box, or none on the table."""
    right = 0
    for box in range(BOXES):
        ids = cloud.instance_ids[truth == box]
        right += np.bincount(ids[ids >= 0], minlength=1).max()
    right += int((cloud.instance_ids[truth == TABLE] == BACKGROUND).sum())
    return right / len(truth)


def share_alike(ids: NDArray[np.int32], other: NDArray[np.int32]) -> float:
    """Share of points on which two labellings agree when instances are matched by their largest overlap."""
    matched = 0
    for value in np.unique(ids):
        same = other[ids == value]
        matched += (same == value).sum() if value < 0 else np.bincount(same[same >= 0], minlength=1).max()
    return float(matched / len(ids))


@pytest.fixture(scope="module")
def known() -> Known:
    return boxes_on_a_table()


@pytest.fixture(scope="module")
def labelled(known: Known) -> LabelledCloud:
    return fit(known.scene, progress=False)


def test_a_folder_is_no_scene() -> None:
    with pytest.raises(SceneError, match=r"scene is a str; expected a Scene, as og\.read_capture\(FOLDER\) returns"):
        fit("kitchen")  # pyright: ignore[reportArgumentType]


def test_boxes_are_found(known: Known, labelled: LabelledCloud) -> None:
    assert len(labelled.instances) == BOXES
    assert share_right(labelled, known.truth) > 0.95
    for box in range(BOXES):
        assert len(np.unique(labelled.instance_ids[known.truth == box])) <= 3


def test_instances_carry_the_feature_of_their_box(known: Known, labelled: LabelledCloud) -> None:
    table = labelled.instances
    np.testing.assert_array_equal(table.descriptor_instance, range(BOXES))
    boxes = [np.bincount(known.truth[labelled.instance_ids == k]).argmax() for k in range(BOXES)]
    assert sorted(boxes) == list(range(BOXES))
    assert ((table.descriptors * DIRECTIONS[1:][boxes]).sum(axis=1) > 0.98).all()
    np.testing.assert_allclose(np.linalg.norm(table.descriptors, axis=1), 1, rtol=1e-5)
    assert (table.views >= 6).all()
    np.testing.assert_array_equal(table.points, np.bincount(labelled.instance_ids[labelled.instance_ids >= 0]))


def test_the_cloud_keeps_what_the_scene_gave(known: Known, labelled: LabelledCloud) -> None:
    np.testing.assert_array_equal(labelled.xyz, known.scene.points.xyz)
    np.testing.assert_array_equal(labelled.origin, known.scene.points.origin)
    np.testing.assert_array_equal(labelled.rgb, known.scene.points.rgb)
    assert labelled.feature_space == SPACE
    assert 0.5 * SPACING < labelled.spacing < 0.8 * SPACING  # strewn at random
    assert labelled.reach > labelled.spacing


def test_provenance_tells_stages_and_states(labelled: LabelledCloud) -> None:
    provenance = labelled.provenance
    assert {"spacing", "visibility", "grouping", "membership", "association"} <= {
        stage["name"] for stage in provenance["stages"]
    }
    assert all(stage["seconds"] >= 0 for stage in provenance["stages"])
    assert provenance["left_out"] == []
    states = provenance["notes"]["points_by_state"]
    assert sum(states.values()) == len(labelled)
    assert provenance["notes"]["views"] == 8
    assert json.loads(json.dumps(provenance))["settings"]["seed"] == 0


def test_a_second_run_gives_the_same_bits(known: Known, labelled: LabelledCloud) -> None:
    again = fit(known.scene, progress=False)
    np.testing.assert_array_equal(again.instance_ids, labelled.instance_ids)
    np.testing.assert_array_equal(again.instances.descriptors, labelled.instances.descriptors)
    np.testing.assert_array_equal(again.instances.visible_area, labelled.instances.visible_area)


def test_order_of_points_does_not_matter(known: Known, labelled: LabelledCloud) -> None:
    order = np.random.default_rng(0).permutation(len(known.truth))
    points = known.scene.points
    shuffled = replace(points, xyz=points.xyz[order], rgb=points.rgb[order])
    ids = fit(replace(known.scene, points=shuffled), progress=False).instance_ids
    assert share_alike(ids, labelled.instance_ids[order]) > 0.998


def test_order_of_views_does_not_matter(known: Known, labelled: LabelledCloud) -> None:
    ids = fit(replace(known.scene, views=known.scene.views[::-1]), progress=False).instance_ids
    assert share_alike(ids, labelled.instance_ids) > 0.99  # the photographs compared with are others


def moved(scene: Scene, turn: NDArray[np.float64], unit: float, shift: NDArray[np.float64]) -> Scene:
    """The scene in another world frame: x -> unit turn x + shift."""
    old = scene.points
    points = Points.from_world(unit * old.xyz_world @ turn.T + shift, rgb=old.rgb)
    views = []
    for view in scene.views:
        pose = np.eye(4)
        pose[:3, :3] = view.camera.world_to_camera[:3, :3] @ turn.T
        center = unit * turn @ (view.camera.center + old.origin) + shift - points.origin
        pose[:3, 3] = -pose[:3, :3] @ center
        views.append(replace(view, camera=replace(view.camera, world_to_camera=pose)))
    return replace(scene, points=points, views=tuple(views))


TURN = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0]
TURN *= np.linalg.det(TURN)
NO_SHIFT = np.zeros(3)


@pytest.mark.parametrize(
    ("turn", "unit", "shift"),
    [
        (TURN, 1.0, NO_SHIFT),
        (np.eye(3), 1000.0, NO_SHIFT),
        (np.eye(3), 0.001, NO_SHIFT),
        (np.eye(3), 1.0, np.array([1e6, -3e6, 500])),
    ],
    ids=["rotated", "millimeters", "kilometers", "map offset"],
)
def test_world_frame_and_unit_do_not_matter(
    known: Known, labelled: LabelledCloud, turn: NDArray[np.float64], unit: float, shift: NDArray[np.float64]
) -> None:
    cloud = fit(moved(known.scene, turn, unit, shift), progress=False)
    assert share_alike(cloud.instance_ids, labelled.instance_ids) > 0.998
    assert cloud.spacing == pytest.approx(unit * labelled.spacing, rel=1e-2)


def test_points_given_twice_get_the_labels_they_had(known: Known, labelled: LabelledCloud) -> None:
    points, count = known.scene.points, len(known.scene.points)
    assert not points.are_gaussians
    again = np.concatenate([np.arange(count), np.arange(count)[::-1]])
    colors = None if points.rgb is None else points.rgb[again]
    cloud = fit(replace(known.scene, points=replace(points, xyz=points.xyz[again], rgb=colors)), progress=False)
    np.testing.assert_array_equal(cloud.instance_ids, labelled.instance_ids[again])
    np.testing.assert_array_equal(cloud.instances.points, 2 * labelled.instances.points)
    (entry,) = cloud.provenance["left_out"]
    assert (entry["key"], entry["what"]) == ("coincident points", f"{count} points")
    assert "exactly where another does" in entry["why"]


def test_order_does_not_matter_where_points_of_other_colors_coincide() -> None:
    random, scene = np.random.default_rng(0), boxes_on_a_table(photographs=True).scene
    points, count = scene.points, len(scene.points)
    assert points.rgb is not None
    again = np.append(np.arange(count), random.integers(0, count, count // 2))
    rgb = points.rgb[again]
    rgb[count:] = random.integers(0, 256, (len(again) - count, 3))
    ordered, reverse = (
        fit(replace(scene, points=replace(points, xyz=points.xyz[again[rows]], rgb=rgb[rows])), progress=False)
        for rows in (np.arange(len(again)), np.arange(len(again))[::-1])
    )
    np.testing.assert_array_equal(reverse.instance_ids[::-1], ordered.instance_ids)
    assert reverse.certainty is not None
    np.testing.assert_array_equal(reverse.certainty[::-1], ordered.certainty)


def test_views_given_twice_do_not_matter(known: Known, labelled: LabelledCloud) -> None:
    twice = (*known.scene.views, *[replace(view, name=f"{view.name} again") for view in known.scene.views])
    cloud = fit(replace(known.scene, views=twice), progress=False)
    assert share_alike(cloud.instance_ids, labelled.instance_ids) > 0.99
    assert len(cloud.instances) == len(labelled.instances)


def test_masks_may_be_read_when_needed(known: Known, labelled: LabelledCloud) -> None:
    def streamed(view: View) -> View:
        return replace(view, masks=view.mask_map, image=view.image_rgb)

    scene = replace(known.scene, views=tuple(streamed(view) for view in known.scene.views))
    np.testing.assert_array_equal(fit(scene, progress=False).instance_ids, labelled.instance_ids)


def test_shapes_of_gaussians_do_not_matter(known: Known, labelled: LabelledCloud) -> None:
    """However a training drew them: faint, large, long."""
    points, rng = known.scene.points, np.random.default_rng(0)
    n = len(points)
    rotation = rng.normal(size=(n, 4))
    gaussians = replace(
        points,
        scale=SPACING * rng.lognormal(0, 1, (n, 3)).astype(np.float32),
        rotation=(rotation / np.linalg.norm(rotation, axis=1, keepdims=True)).astype(np.float32),
        opacity=rng.random(n, np.float32),
    )
    cloud = fit(replace(known.scene, points=gaussians), progress=False)
    np.testing.assert_array_equal(cloud.instance_ids, labelled.instance_ids)
    assert "scale, rotation and opacity of the Gaussians" in {entry["what"] for entry in cloud.provenance["left_out"]}


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("tile_points", [None, 1 << 12])
def test_one_gaussian_that_diverged_does_no_harm(known: Known, tile_points: int | None) -> None:
    """Files may hold scales up to float32's largest."""
    points = known.scene.points
    n = len(points)
    scale = np.full((n, 3), 0.4 * SPACING, np.float32)
    scale[5] = 3e38
    gaussians = replace(
        points, scale=scale, rotation=np.tile(np.float32([1, 0, 0, 0]), (n, 1)), opacity=np.full(n, 0.1, np.float32)
    )
    cloud = fit(replace(known.scene, points=gaussians), FitSettings(tile_points=tile_points), progress=False)
    assert share_right(cloud, known.truth) > 0.8


@pytest.mark.slow
def test_photographs_are_not_needed(known: Known) -> None:
    scene = boxes_on_a_table(photographs=True).scene
    assert all(view.image is not None for view in scene.views)
    np.testing.assert_array_equal(
        fit(scene, progress=False).instance_ids, fit(known.scene, progress=False).instance_ids
    )


def test_one_view_works_and_warns(known: Known) -> None:
    scene = replace(known.scene, views=known.scene.views[:1])
    cloud = fit(scene, progress=False)
    assert any("one view" in warning for warning in cloud.provenance["warnings"])
    assert len(cloud.instances) >= BOXES - 1
    boxes = [np.bincount(known.truth[cloud.instance_ids == k]).argmax() for k in range(len(cloud.instances))]
    assert len(set(boxes) - {TABLE}) == len(boxes)


def test_cameras_that_see_nothing_are_an_error(known: Known) -> None:
    views = tuple(turned_away(view) for view in known.scene.views)
    onto_a_map = replace(known.scene.points, origin=known.scene.points.origin + np.array([431000, 5412000, 0]))
    with pytest.raises(SceneError, match=r"no camera sees the cloud.*; the cloud spans 43\d{4}\.\d\.\.43") as caught:
        prepare(replace(known.scene, views=views, points=onto_a_map))
    # Also the cameras where the world has them, so that one sees whether an offset is missing.
    lowest = min(view.camera.center[1] for view in views) + onto_a_map.origin[1]
    assert f" x {lowest:.1f}.." in str(caught.value).partition("cameras stand at")[2]


def turned_away(view: View) -> View:
    half_turn = np.diag([-1.0, 1, -1, 1])
    return replace(view, camera=replace(view.camera, world_to_camera=half_turn @ view.camera.world_to_camera))


def test_instances_keep_their_masks_when_a_group_is_dismissed(known: Known) -> None:
    """The table, larger than any box, has a mask in one view of eight: noise of the proposer."""
    first = known.scene.views[0]
    ids = first.mask_map().copy()
    ids[cast(THINGS, first.camera)[1] == -1] = BOXES
    features = np.append(first.mask_features, DIRECTIONS[:1], axis=0)
    views = (replace(first, masks=ids, mask_features=features), *known.scene.views[1:])
    settings = FitSettings(membership=MembershipSettings(rate_share=0.5))
    cloud = fit(replace(known.scene, views=views), settings, progress=False)
    assert any("groups of masks" in entry["what"] for entry in cloud.provenance["left_out"])
    assert share_right(cloud, known.truth) > 0.95
    assert len(cloud.instances) == BOXES
    boxes = [np.bincount(known.truth[cloud.instance_ids == k]).argmax() for k in range(BOXES)]
    assert ((cloud.instances.descriptors * DIRECTIONS[1:][boxes]).sum(axis=1) > 0.98).all()


def tiny_scene(n: int, width: int = 8, height: int = 8, focal: float = 8.0) -> Scene:
    xyz = np.zeros((n, 3))
    xyz[:, 0] = 0.1 * np.arange(n)
    pose = np.eye(4)
    pose[2, 3] = 2
    masks = np.zeros((height, width), np.int32)
    image = np.full((height, width, 3), 90, np.uint8)
    views = tuple(
        View(
            str(i),
            Camera(width, height, focal, focal, width / 2, height / 2, pose),
            masks,
            np.ones((1, 4), np.float32),
            image,
        )
        for i in range(2)
    )
    return Scene(Points.from_world(xyz, rgb=np.full((n, 3), 200, np.uint8)), views, "test-space")


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_a_few_points_in_one_mask_are_one_instance(n: int) -> None:
    cloud = fit(tiny_scene(n), progress=False)
    assert cloud.instance_ids.tolist() == [0] * n
    assert cloud.spacing > 0


@pytest.mark.parametrize(("width", "height"), [(1, 1), (1, 8), (2, 2)])
def test_tiny_images(width: int, height: int) -> None:
    for focal in (8.0, 200.0):  # points less than a pixel apart, and ten pixels
        assert fit(tiny_scene(3, width, height, focal=focal), progress=False).instance_ids.shape == (3,)


def test_pixels_beyond_those_that_mode_paper_renders_are_left_out() -> None:
    settings = FitSettings(mode="paper", paper=PaperSettings(image_pixels=30 * 22))
    scene, journal = tiny_scene(3, 60, 44, focal=200.0), Journal(progress=False)
    prepared = prepare(scene, settings, journal)
    np.testing.assert_array_equal(prepared.table.mask_pixels, [30 * 22] * 2)
    assert any(key is LeftOut.PIXELS_IN_PAPER_MODE for key, _ in journal.left_out)
    assert fit(scene, progress=False).instance_ids.tolist() == [0] * 3


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (lambda: GeometrySettings(reach=0), "reach is 0; expected a finite number above 0, by default 3"),
        (lambda: MembershipSettings(gap_sizes=float("nan")), "gap_sizes is nan; .* a finite number of at least 0,"),
        (lambda: GeometrySettings(reach=float("inf")), "reach is inf; expected a finite number above 0, by default 3"),
        (lambda: GeometrySettings(scales=()), r"scales is \(\); expected a tuple of numbers above 0"),
        (lambda: GeometrySettings(opacity=1.5), "opacity is 1.5; expected a finite number above 0 and at most 1"),
        (lambda: GeometrySettings(enough_views=0), "enough_views is 0; expected a whole number above 0"),
        (lambda: GroupingSettings(graph_points=0.5), "graph_points is 0.5; expected a whole number above 0"),  # type: ignore[arg-type]
        (lambda: FitSettings(mode="quick"), "mode is 'quick'; expected one of 'grouping', 'fast', 'paper', 'auto'"),  # type: ignore[arg-type]
        (lambda: FitSettings(memory="4GB"), "memory is '4GB'; expected a whole number above 0"),  # type: ignore[arg-type]
        (lambda: FitSettings(memory=10**400), "memory is 10{400}; expected a whole number above 0 and below 2.63"),
        (lambda: GroupingSettings(join_majority=10**400), "join_majority is 10{400}; .* number of at least 0, by"),
        (lambda: FitSettings(seed=True), "seed is True; expected a whole number of at least 0"),
        (lambda: FitSettings(membership=None), r"membership is None; expected a MembershipSettings \(FitSettings\)"),  # type: ignore[arg-type]
        (lambda: MatchingSettings(relative="no"), "relative is 'no'; expected a bool, by default False"),  # type: ignore[arg-type]
        (lambda: CodebookSettings(k1=0), "k1 is 0; expected a whole number above 0"),
        (lambda: FeatureSettings(width=-1), "width is -1; expected a whole number above 0"),
        (lambda: FeatureSettings(intra=False, inter=False), "both losses are off"),
        (lambda: PaperSettings(schedule_share=0.0), "schedule_share is 0.0; expected a finite number above 0"),
    ],
)  # fmt: skip
def test_settings_that_mean_nothing_are_refused(settings: Callable[[], object], message: str) -> None:
    with pytest.raises(OgPointcloudError, match=message):
        settings()


def test_a_fit_without_an_instance_says_so() -> None:
    never = MembershipSettings(rate_share=2.0)  # no instance is detected twice as often as is typical
    cloud = fit(boxes_on_a_table().scene, FitSettings(membership=never), progress=False)
    assert len(cloud.instances) == 0
    assert any("no instance was found" in warning for warning in cloud.provenance["warnings"])


def test_progress_of_training_says_nothing_without_a_terminal(capsys):
    with Journal(progress=True).bars() as report:
        for name in ("features", "codebook"):
            for step in (1, 2):
                report(name, step, 2, 0.5)
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize("terminal", [False, True])
def test_compiling_is_told_and_timed(terminal, monkeypatch, capsys):
    """Once on a terminal, where bars would seem to hang; its seconds are noted, and nothing where all was compiled."""
    monkeypatch.setattr("sys.stderr.isatty", lambda: terminal, raising=False)
    first, later = Journal(progress=True), Journal(progress=True)
    with timed_compiling(first):
        for _ in range(2):
            with trigger_event("numba:compile"), trigger_event("numba:compile"):
                time.sleep(0.02)
    with timed_compiling(later):
        pass
    assert capsys.readouterr().err.count("compiling") == terminal
    assert first.notes["compiling"] > 0
    assert later.notes == {}
