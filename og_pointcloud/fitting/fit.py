"""fit(scene) -> LabelledCloud: the stages in order, timed, skipping what the scene does not need."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.cloud import BACKGROUND, UNOBSERVED, LabelledCloud
from og_pointcloud.errors import SceneError
from og_pointcloud.fitting.labellers import Labelling, Prepared, as_published, by_choice, by_features, by_grouping
from og_pointcloud.fitting.mask_table import Cutoffs, Gaussians, MaskTable, mask_table, table_key, working_memory
from og_pointcloud.fitting.membership import without_see_through
from og_pointcloud.fitting.memory import free_memory, memory_in_use
from og_pointcloud.fitting.table_store import TableStore, remove_work
from og_pointcloud.journal import Journal
from og_pointcloud.kernels import get_num_threads
from og_pointcloud.rendering.coverage import needed_views
from og_pointcloud.rendering.geometry import (
    GeometryChoice,
    Neighbourhood,
    choose_gaussians,
    distinct_places,
    isotropic,
    near_plane,
    neighbourhood,
    pixels_per_spacing,
    thinned,
)
from og_pointcloud.scene import Points, Scene, View
from og_pointcloud.settings import FitSettings, GeometrySettings

__all__ = ["Prepared", "fit", "prepare"]


def fit(
    scene: Scene,
    settings: FitSettings | None = None,
    *,
    progress: bool = True,
    prepared: Prepared | None = None,
    work: str | os.PathLike[str] | None = None,
) -> LabelledCloud:
    """Label a scene: which points form one instance, and what the encoder saw of each.

    prepared: what `prepare` made of the same scene and settings, where it is at hand already.
    work: a folder in which the views of a long fit are kept, so that the next call goes on where this one was
    interrupted or killed; its files are removed at the end. None: nothing is kept.

    Deterministic: the same scene and settings give the same ids on every run. Raises SceneError where the scene
    cannot give an instance at all (no masks, or no camera that sees the cloud).
    """
    settings = settings or FitSettings()
    journal = Journal(progress)
    check_scene(scene, journal)
    whole, place = scene, None
    if prepared is None:
        scene = with_needed_views(scene, settings, journal)
        scene, place = with_distinct_points(scene, journal)
        prepared = prepare(scene, settings, journal, work)
    road = {"auto": by_choice, "grouping": by_grouping, "fast": by_features, "paper": as_published}[settings.mode]
    labelling = road(scene, prepared, settings, journal)
    if work is not None:
        remove_work(Path(work))
    return labelled_cloud(whole, labelling, place, prepared.neighbourhood.spacing, settings, journal)


def prepare(
    scene: Scene,
    settings: FitSettings | None = None,
    journal: Journal | None = None,
    work: str | os.PathLike[str] | None = None,
) -> Prepared:
    """The stages that every method shares: point spacing, Gaussians, and the mask table of all views. work: see `fit`;
    its files hold the table that is returned, and stay."""
    settings = settings or FitSettings()
    journal = journal or Journal(progress=False)
    memory = settings.memory or memory_in_use() + free_memory() // 2
    with journal.stage("spacing"):
        near = near_plane(scene.points.xyz, scene.views)
        around = neighbourhood(scene.points.xyz, settings.geometry)
    with journal.stage("geometry"):
        gaussians = _gaussians(scene, around, near, settings, journal)
    with journal.stage("visibility"):
        stride = pixel_stride(scene.points, around.spacing, scene.views, settings.geometry, journal)
        views = (thinned(view, stride) for view in journal.steps(scene.views, "visibility"))
        thickness = _surface_thickness(gaussians, around, settings.geometry)
        store, at_once = _store(scene, gaussians, near, thickness, memory, work, settings)
        table = mask_table(gaussians, views, near, thickness, store, at_once, cutoffs(settings))
        journal.notes["table"] = {
            "views": len(store.marks),
            "entries": store.entries,
            "on_disk": store.on_disk,
            "views_side_by_side": at_once,
        }
        if store.resumed:
            journal.leave_out(f"rendering of {store.resumed} views", f"an interrupted fit kept them in '{work}'")
        _check_sight(scene, table)
        table = replace(table, mask_pixels=table.mask_pixels * stride**2)
        table = _front_surfaces(scene, table, gaussians, settings, journal)
    return Prepared(around, gaussians, near, stride, table)


def _check_sight(scene: Scene, table: MaskTable) -> None:
    if table.exposure.nnz == 0:
        raise SceneError(
            f"no camera sees the cloud: {len(scene.points)} points, {len(scene.views)} views, none in any image; check "
            "that poses and cloud share one frame and that poses are camera-to-world (transforms.json) as documented"
        )
    if table.weights.nnz == 0:
        raise SceneError(
            f"none of the {len(table.mask_view)} masks shows a Gaussian; expected at least one: make masks, and check "
            "that poses and cloud share one frame"
        )


def check_scene(scene: Scene, journal: Journal) -> None:
    """Refuse a scene without masks; note its size."""
    masks = sum(view.mask_count for view in scene.views)
    if masks == 0:
        raise SceneError(f"none of the {len(scene.views)} views has a mask; expected at least one: make masks first")
    if len(scene.views) == 1:
        journal.warnings.append("one view: nothing can contradict its masks, so every mask is an instance")
    journal.notes.update(points=len(scene.points), views=len(scene.views), masks=masks)


def with_needed_views(scene: Scene, settings: FitSettings, journal: Journal) -> Scene:
    """The scene with the views that see something new, where the settings ask for that, else with all."""
    enough = settings.visibility.enough_views
    needed = range(len(scene.views)) if enough is None else needed_views(scene.points.xyz, scene.views, enough)
    if len(needed) in (0, len(scene.views)):
        return scene
    journal.leave_out(
        f"{len(scene.views) - len(needed)} of {len(scene.views)} views",
        f"nearly all that they see is seen by {enough} others",
    )
    return replace(scene, views=tuple(scene.views[index] for index in needed))


def with_distinct_points(scene: Scene, journal: Journal) -> tuple[Scene, NDArray[np.int64] | None]:
    """The scene with one point a place, and which of them speaks for each of its points; None where all differ.

    A point hides another at its very place, which would then seem unseen. Gaussians stay: their overlap is the scene's.
    """
    points = scene.points
    if points.are_gaussians:
        return scene, None
    first, place = distinct_places(points.xyz)
    if len(first) == len(points):
        return scene, None
    journal.leave_out(f"{len(points) - len(first)} points", "they lie exactly where another lies, and get its label")
    columns = {
        name: None if value is None else value[first]
        for name, value in (("rgb", points.rgb), ("normals", points.normals))
    }
    return replace(scene, points=replace(points, xyz=points.xyz[first], **columns)), place


def _gaussians(scene: Scene, around: Neighbourhood, near: float, settings: FitSettings, journal: Journal) -> Gaussians:
    if scene.points.are_gaussians:
        journal.leave_out("choice of scale and opacity", "the file holds Gaussians")
        return Gaussians.from_points(scene.points)
    if settings.mode == "paper":
        journal.leave_out("choice of scale and opacity", "mode paper draws points as full as trained Gaussians are")
        return isotropic(scene.points, around.spacing, settings.paper.scale, settings.paper.opacity)
    choice = choose_gaussians(
        scene.points,
        around.spacing,
        scene.views,
        near,
        settings.geometry,
        lambda values: journal.steps(values, "geometry"),
    )
    note_choice(choice, journal)
    return choice.gaussians


def note_choice(choice: GeometryChoice, journal: Journal) -> None:
    """How a plain cloud's points are drawn, and why; a warning where there was nothing to go by."""
    journal.notes["gaussian_scale"], journal.notes["gaussian_opacity"] = choice.scale, choice.opacity
    journal.notes["photometric_trials"] = [list(trial) for trial in choice.trials]
    if not choice.trials:
        journal.warnings.append(
            f"no colours or images to compare with: points are drawn {choice.scale} spacings large, {choice.opacity} "
            "opaque; add images for a choice by photometric agreement"
        )


def _surface_thickness(gaussians: Gaussians, around: Neighbourhood, settings: GeometrySettings) -> NDArray[np.float32]:
    """(n,) how far behind the front of its surface a Gaussian may lie: noise and overlap are a few spacings thick."""
    typical = np.median(around.spacing)
    thickness = settings.thickness * np.maximum(around.spacing, typical) + 3 * gaussians.scale.max(axis=1)
    return thickness.astype(np.float32)


def pixel_stride(
    points: Points, spacing: NDArray[np.float32], views: Sequence[View], settings: GeometrySettings, journal: Journal
) -> int:
    """Use every stride-th pixel of the masks: pixels much finer than the points see nothing new."""
    if points.are_gaussians:
        return 1
    apart = pixels_per_spacing(points, spacing, views)
    smallest = min(min(view.camera.width, view.camera.height) for view in views)
    stride = int(np.clip(apart / settings.pixels_per_spacing, 1, min(settings.max_stride, smallest)))
    if stride > 1:
        journal.leave_out(
            f"{1 - 1 / stride**2:.0%} of the pixels",
            f"points lie {apart:.1f} px apart: one row and column in {stride} is enough",
        )
    return stride


def _store(
    scene: Scene,
    gaussians: Gaussians,
    near: float,
    thickness: NDArray[np.float32],
    memory: int,
    work: str | os.PathLike[str] | None,
    settings: FitSettings,
) -> tuple[TableStore, int]:
    """Where the table goes, and how many views are worked on side by side, so that neither outgrows its memory."""
    left = max(0, memory - memory_in_use())
    visibility = settings.visibility
    largest = max((view.camera for view in scene.views), key=lambda camera: camera.width * camera.height)
    one = working_memory(len(gaussians), largest)
    at_once = int(np.clip(visibility.views_share * left // one, 1, min(get_num_threads(), len(scene.views))))
    share = visibility.table_share * max(0, left - at_once * one)
    folder = None if work is None else Path(work)
    key = "" if folder is None else table_key(gaussians, near, thickness, cutoffs(settings))
    return TableStore(len(gaussians), share, folder, key, visibility.keep_after_s), at_once


def cutoffs(settings: FitSettings) -> Cutoffs:
    """Where blending stops looking."""
    return Cutoffs(settings.visibility.alpha_min, settings.visibility.transmittance_min)


def _front_surfaces(
    scene: Scene, table: MaskTable, gaussians: Gaussians, settings: FitSettings, journal: Journal
) -> MaskTable:
    depth_rows = np.stack([view.camera.world_to_camera[2] for view in scene.views])
    focal = np.sqrt([view.camera.fx * view.camera.fy for view in scene.views])
    table, share = without_see_through(table, gaussians, depth_rows, focal, settings.membership)
    journal.notes["seen_through"] = round(share, 5)
    return table


def labelled_cloud(
    scene: Scene,
    labelling: Labelling,
    place: NDArray[np.int64] | None,
    spacing: NDArray[np.float32],
    settings: FitSettings,
    journal: Journal,
) -> LabelledCloud:
    """The scene's points with their labels, and how they came about; a warning where there is no instance.

    place: for each point of the scene the row of the labelling that speaks for it; None: its own.
    """
    ids, certainty = labelling.instance_ids, labelling.certainty
    if place is not None:
        ids, certainty = ids[place], None if certainty is None else certainty[place]
    typical = float(np.median(spacing))
    states = {"labelled": ids >= 0, "background": ids == BACKGROUND, "unobserved": ids == UNOBSERVED}
    journal.notes["points_by_state"] = {name: int(state.sum()) for name, state in states.items()}
    journal.notes["instances"] = len(labelling.instances)
    if len(labelling.instances) == 0:
        journal.warnings.append("no instance was found: every mask is contradicted by other views or shows no point")
    return LabelledCloud(
        xyz=scene.points.xyz,
        origin=scene.points.origin,
        instance_ids=ids,
        instances=labelling.instances,
        feature_space=scene.feature_space,
        spacing=typical,
        reach=settings.geometry.reach * typical,
        rgb=scene.points.rgb,
        certainty=None if certainty is None else np.rint(255 * certainty).astype(np.uint8),
        provenance=journal.provenance(settings),
    )
