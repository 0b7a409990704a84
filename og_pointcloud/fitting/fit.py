"""fit(scene) -> LabelledCloud: the stages in order, timed, skipping what the scene does not need."""

from __future__ import annotations

import os
from concurrent.futures import Executor
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from og_pointcloud.checking.check import check_capture, check_cloud, warn_of_doubts, with_checks
from og_pointcloud.cloud import BACKGROUND, UNOBSERVED, LabelledCloud
from og_pointcloud.errors import SceneError
from og_pointcloud.fitting.held_out import choose_scale, note_scale
from og_pointcloud.fitting.labellers import LABELLERS, Labelling, paper
from og_pointcloud.fitting.mask_edges import with_masks_to_edges
from og_pointcloud.fitting.mask_table import MaskTable, mask_table, require_sight
from og_pointcloud.fitting.memory import in_file, memory_left
from og_pointcloud.fitting.photographs import Photographs
from og_pointcloud.fitting.reliability import likely_cause, split_half
from og_pointcloud.fitting.see_through import without_see_through
from og_pointcloud.fitting.seen_colors import doubted_by_color
from og_pointcloud.fitting.tiles import fit_tiles, needs_tiles
from og_pointcloud.fitting.work_folder import WorkFolder
from og_pointcloud.journal import Journal, LeftOut
from og_pointcloud.kernels import get_num_threads, timed_compiling
from og_pointcloud.rendering.geometry import drawn_spacing, isotropic
from og_pointcloud.rendering.pixel_cells import typical_spacing
from og_pointcloud.rendering.smoothing import smoothed
from og_pointcloud.rendering.splatting import working_memory
from og_pointcloud.rendering.surface import Surface, reconstruct_surface
from og_pointcloud.scene import Scene
from og_pointcloud.settings import FitSettings, fit_settings

VIEWS_MEMORY_SHARE, TABLE_MEMORY_SHARE = 0.3, 0.4
"""Shares of the memory left that views worked on side by side may fill (there is always one), and of the rest that the
mask table may fill; a larger one is on disk. What is derived from it takes as much."""
KEEP_AFTER_S = 20.0
"""Finished views are kept for a restart only where all views together take longer than this, in seconds."""


def fit(
    scene: Scene,
    settings: FitSettings | None = None,
    *,
    work: str | os.PathLike[str] | None = None,
    executor: Executor | None = None,
    progress: bool = True,
) -> LabelledCloud:
    """Label a scene: which points form one instance, and what the encoder saw of each.

    A cloud that would not fit into memory as a whole is fitted in tiles (tiles.py); `FitSettings.memory` and
    `FitSettings.tile_points` decide.

    work: a folder that keeps the views of a long fit, and the training of mode "paper", so that the next call resumes
    where this one was interrupted or killed; its files are removed at the end. None: nothing is kept.
    executor: of `concurrent.futures`, takes the tiles and views of a fit in tiles as tasks. Its workers must see the
    work folder (without one, the folder for temporary files) by the same path. The result is the same, bit for bit.
    progress: show bars on a terminal.

    The capture is checked first, and the result last (og_pointcloud.checking). A `CaptureWarning` says what does not
    fit together; provenance["checks"] has every check. They change no label.

    Deterministic: the same scene and settings give the same ids on every run. Raises SceneError where the scene
    cannot give an instance at all (no masks, or no camera that sees the cloud), and OgPointcloudError where memory or
    disk are too small, or another process uses the work folder.

    A wall that three views show from the same place, its left half in one mask and its right half in another:

    >>> import numpy as np
    >>> import og_pointcloud as og
    >>> from og_pointcloud.scene import Points, Scene, View
    >>> x, y = np.meshgrid(np.linspace(-1, 1, 40), np.linspace(-1, 1, 40))
    >>> points = Points(np.stack([x, y, np.full_like(x, 2)], axis=-1).reshape(-1, 3).astype(np.float32), np.zeros(3))
    >>> camera = og.Camera(64, 64, 64.0, 64.0, 32.0, 32.0, np.eye(4))
    >>> masks = np.repeat(np.arange(64)[None] >= 32, 64, axis=0).astype(np.int32)
    >>> views = tuple(View(name, camera, masks, np.eye(2, dtype=np.float32)) for name in "abc")
    >>> scene = Scene(points, views, "two-words")
    >>> wall = og.fit(scene, progress=False)
    >>> wall.instances.points
    array([800, 800], dtype=int32)
    """
    if not isinstance(scene, Scene):
        raise SceneError(f"scene is a {type(scene).__name__}; expected a Scene, as og.read_capture(FOLDER) returns")
    settings = fit_settings(settings)
    journal = Journal(progress)
    with timed_compiling(journal):
        with journal.stage("checks"):
            checks = check_capture(scene)
        warn_of_doubts(checks)
        # The folder's files are removed once the cloud is made: only a run that ends earlier leaves them.
        with WorkFolder.open(work) as kept:
            if needs_tiles(scene, settings):
                _check(scene, journal)
                labelling, spacing = fit_tiles(_with_edges(scene, journal), settings, kept, journal, executor)
                cloud = _cloud_of(scene, labelling, spacing, settings, journal)
            else:
                prepared = prepare(scene, settings, journal, kept)
                # A temporary folder goes with the run: checkpoints in it would serve nobody.
                cloud = fit_prepared(prepared, settings, journal, None if work is None else kept)
    found = check_cloud(cloud, checks)
    warn_of_doubts(found)
    return with_checks(cloud, [*checks, *found])


@dataclass(frozen=True)
class Prepared:
    """Results of the stages before labelling, shared by all modes but "paper", which draws points differently.

    scene: as given. surface: how it is drawn. table: what every mask shows of every Gaussian of the surface, without
    what lies behind a mask's object (see_through.py). Views cut from one photograph are one view of the table, except
    in mode "paper".
    """

    scene: Scene
    surface: Surface
    table: MaskTable


def prepare(
    scene: Scene,
    settings: FitSettings | None = None,
    journal: Journal | None = None,
    work: WorkFolder | None = None,
) -> Prepared:
    """The stages of `fit` before labelling: surface and mask table of the scene as a whole."""
    settings = settings or FitSettings()
    journal = journal or Journal(progress=False)
    _check(scene, journal)
    if settings.mode != "paper":
        scene = _with_edges(scene, journal)
    surface = _as_drawn(reconstruct_surface(scene, settings, journal), settings, journal)
    with WorkFolder.open(None) if work is None else nullcontext(work) as kept:
        return Prepared(scene, surface, _mask_table(surface, settings, journal, kept))


def fit_prepared(
    prepared: Prepared,
    settings: FitSettings | None = None,
    journal: Journal | None = None,
    work: WorkFolder | None = None,
) -> LabelledCloud:
    """The stages of `fit` from the mask table on. Settings of earlier stages stay as it was prepared with.

    work: keeps the training of mode "paper", the only labeller that takes hours; None: nothing is kept.
    """
    settings = settings or FitSettings()
    journal = journal or Journal(progress=False)
    labeller = partial(paper, work=work) if settings.mode == "paper" else LABELLERS[settings.mode]
    labelling = labeller(prepared.table, prepared.surface, settings, journal)
    return labelled_cloud(prepared, _with_reliability(labelling, prepared, settings, journal), settings, journal)


def labelled_cloud(prepared: Prepared, labelling: Labelling, settings: FitSettings, journal: Journal) -> LabelledCloud:
    """The scene's points with the labels of the surface's points."""
    spacing = typical_spacing(prepared.scene.points.xyz, prepared.surface.neighborhood.spacing)
    # Points at the same place, or in the same cell, are one point of the surface, and get one label.
    labelling = labelling.of_points(prepared.surface.row_of_point)
    return _cloud_of(prepared.scene, labelling, spacing, settings, journal)


def _with_reliability(labelling: Labelling, prepared: Prepared, settings: FitSettings, journal: Journal) -> Labelling:
    """The labelling with the reliability of each instance; a warning if the scene's is low."""
    with journal.stage("reliability"):
        found = split_half(prepared.table, prepared.surface, labelling, settings)
    if found is None:
        return labelling
    instances = replace(labelling.instances, reliability=found.of_instance)
    overall = instances.overall_reliability
    if overall is not None:
        journal.notes["reliability"] = round(overall, 4)
        if overall < settings.reliable:
            journal.warnings.append(f"reliability {overall:.2f}, below {settings.reliable:g}: {likely_cause(found)}")
    return replace(labelling, instances=instances)


def _check(scene: Scene, journal: Journal) -> None:
    """Refuse a scene without masks; note its size."""
    masks = sum(view.mask_count for view in scene.views)
    if masks == 0:
        raise SceneError(f"none of the {len(scene.views)} views has a mask; expected at least one: make masks first")
    if len(scene.views) == 1:
        journal.warnings.append("only one view: nothing can contradict its masks, so every mask is an instance")
    journal.notes.update(points=len(scene.points), views=len(scene.views), masks=masks)


def _with_edges(scene: Scene, journal: Journal) -> Scene:
    """The scene with masks that end where photographs change."""
    with journal.stage("mask edges"):
        return with_masks_to_edges(scene, journal)


def _as_drawn(surface: Surface, settings: FitSettings, journal: Journal) -> Surface:
    """The surface with points as large as held-out views find best, and at smoothed positions."""
    # Mode paper draws points as full as trained Gaussians are.
    if settings.mode == "paper":
        return surface
    points = surface.scene.points
    spacing = drawn_spacing(points.xyz, surface.neighborhood)
    with journal.stage("point size"):
        choice = choose_scale(points, spacing, surface.thickness, surface.scene.views, surface.near, settings, journal)
        note_scale(choice, journal)
        # Only now: sizes that agree about as well as each other would change places with every small move of points.
        points = replace(points, xyz=smoothed(points.xyz, surface.neighborhood))
    drawn = isotropic(points, spacing, choice.scale, settings.geometry.opacity)
    return replace(surface, scene=replace(surface.scene, points=points), gaussians=drawn)


def _mask_table(surface: Surface, settings: FitSettings, journal: Journal, work: WorkFolder) -> MaskTable:
    """The mask table of a surface, without what its masks show behind their objects. The table, and the views rendered
    at the same time, each stay within their share of the memory."""
    views = surface.scene.views
    with journal.stage("visibility"):
        # As many views at once as fit into their share, at least one; the table gets its share of the rest.
        left = memory_left(settings.memory)
        largest = max((view.camera for view in views), key=lambda camera: camera.width * camera.height)
        one_view = working_memory(len(surface.gaussians), largest)
        at_once = int(np.clip(VIEWS_MEMORY_SHARE * left // one_view, 1, min(get_num_threads(), len(views))))
        most = TABLE_MEMORY_SHARE * max(0, left - at_once * one_view)
        work.hold(most, KEEP_AFTER_S)
        table = mask_table(
            surface.gaussians,
            journal.steps(views, "visibility"),
            surface.near,
            surface.thickness,
            work=work,
            side_by_side=at_once,
            most_in_memory=most,
        )
        journal.notes["table"] = {
            "views": len(views),
            "entries": sum(matrix.nnz for matrix in (table.weights, table.outside, table.exposure)),
            "on_disk": in_file(table.exposure.data),
            "views_side_by_side": at_once,
        }
        if work.found:  # views of an interrupted fit
            journal.leave_out(LeftOut.RENDERING, count=work.found, folder=work.place().name)
        require_sight(table.exposure.nnz, table.weights.nnz, surface.scene)
        table = front_surfaces(surface, table, settings, journal)
        if settings.mode == "paper":  # renders views again, and needs the masks of each
            return table
        table = doubted_by_color(table, surface.scene.points, views, surface.near, journal)
        return Photographs.of(views).joined(table)


def front_surfaces(surface: Surface, table: MaskTable, settings: FitSettings, journal: Journal) -> MaskTable:
    """The table without what its masks show behind their objects (`without_see_through`)."""
    cameras = [view.camera for view in surface.scene.views]
    table, share = without_see_through(table, surface.gaussians, cameras, settings.membership)
    journal.notes["seen_through"] = round(share, 5)
    return table


def _cloud_of(
    scene: Scene, labelling: Labelling, spacing: float, settings: FitSettings, journal: Journal
) -> LabelledCloud:
    """The scene's points with their labels and provenance; a warning if there is no instance."""
    ids, certainty = labelling.instance_ids, labelling.certainty
    states = {"labelled": ids >= 0, "background": ids == BACKGROUND, "unobserved": ids == UNOBSERVED}
    journal.notes["points_by_state"] = {name: int(state.sum()) for name, state in states.items()}
    journal.notes["instances"] = len(labelling.instances)
    if len(labelling.instances) == 0:
        journal.warnings.append("no instance was found: every mask is contradicted by other views or shows no points")
    return LabelledCloud(
        xyz=scene.points.xyz,
        origin=scene.points.origin,
        instance_ids=ids,
        instances=labelling.instances,
        feature_space=scene.feature_space,
        spacing=spacing,
        reach=settings.geometry.reach * spacing,
        rgb=scene.points.rgb,
        certainty=None if certainty is None else np.rint(255 * certainty).astype(np.uint8),  # as files keep it
        provenance=journal.provenance(settings),
        cameras=tuple(view.camera for view in scene.views),
    )
