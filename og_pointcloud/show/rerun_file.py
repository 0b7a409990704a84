"""Frames, masks and the instances that appear in them, as a .rrd file for the Rerun viewer. Needs the extra 'rerun'.

A sink for streams (`RerunSink`), and a fit's input and result with one view per step (`write_rerun`). Nothing is served
and no viewer is started: the file can be viewed anywhere and at any time. Coordinates are in the scene's local frame.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.ask.labelled_scene import LabelledScene
from og_pointcloud.ask.picking import NO_POINT, front_points, in_world
from og_pointcloud.cloud import LabelledCloud
from og_pointcloud.formats.atomic import StrPath, replacing
from og_pointcloud.formats.colors import NO_LABEL, label_colors
from og_pointcloud.journal import Journal
from og_pointcloud.scene import Camera, Scene

rerun: Any = import_module("rerun")  # the package has no type information
APPLICATION, TIMELINE = "og_pointcloud", "view"
JPEG_QUALITY = 80


class RerunSink:
    """Logs views and instances to a file; made by `rerun_sink`. Steps are increasing integers."""

    def __init__(self, recording: Any) -> None:
        self._recording = recording

    def frame(
        self, step: int, camera: Camera, image: NDArray[np.uint8] | None, masks: NDArray[np.integer] | None
    ) -> None:
        """Log a view: its camera in the local frame; its image (H, W, 3) uint8 and masks (H, W), -1 outside, if any."""
        self._recording.set_time(TIMELINE, sequence=step)
        from_camera = rerun.Transform3D(translation=camera.center, mat3x3=camera.world_to_camera[:3, :3].T)
        matrix = [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]
        lens = rerun.Pinhole(
            image_from_camera=matrix, resolution=[camera.width, camera.height], camera_xyz=rerun.ViewCoordinates.RDF
        )
        self._recording.log("world/camera", from_camera, lens)
        if image is not None:
            self._recording.log("world/camera/image", rerun.Image(image).compress(jpeg_quality=JPEG_QUALITY))
        if masks is not None:
            # 0, which the viewer leaves transparent, is outside every mask, or not seen by the lens.
            ids = np.asarray(np.maximum(masks, -1) + 1, np.uint16)
            self._recording.log("world/camera/masks", rerun.SegmentationImage(ids, opacity=0.5))

    def instances(self, step: int, scene: LabelledScene, appeared: NDArray[np.bool_]) -> None:
        """Log the scene's points, colored by instance for the instances that have appeared so far, (K,) bool; and the
        boxes of these instances with their best words."""
        cloud = scene.cloud
        table = np.full((len(appeared) + 3, 3), NO_LABEL, np.uint8)  # negative ids index it from its end
        table[: len(appeared)][appeared] = label_colors(np.flatnonzero(appeared))
        known = [
            (row, box) for row in scene.instances if appeared[row.id] and (box := row.axis_aligned_box) is not None
        ]
        self._recording.set_time(TIMELINE, sequence=step)
        points = rerun.Points3D(cloud.xyz, colors=table[cloud.instance_ids], radii=0.7 * cloud.spacing)
        self._recording.log("world/points", points)
        lines = rerun.Boxes3D(
            mins=[box.low - cloud.origin for _, box in known],
            sizes=[box.size for _, box in known],
            colors=label_colors(np.array([row.id for row, _ in known], np.int64)),
            labels=[row.words[0][0] if row.words else f"instance {row.id}" for row, _ in known],
        )
        self._recording.log("world/boxes", lines)

    def text(self, text: str) -> None:
        """Log a line of text at the first view."""
        self._recording.set_time(TIMELINE, sequence=0)
        self._recording.log("fit", rerun.TextLog(text))


@contextmanager
def rerun_sink(path: StrPath) -> Iterator[RerunSink]:
    """A sink whose file is moved to its path when the block ends without an error."""
    recording = rerun.RecordingStream(APPLICATION)
    with replacing(path) as file:
        recording.save(file.name)  # written as it is logged: memory does not grow with the stream
        try:
            yield RerunSink(recording)
        finally:
            recording.disconnect()


def write_rerun(path: StrPath, capture: Scene, cloud: LabelledCloud, *, progress: bool = False) -> None:
    """Write a fit's input and result: each view with its masks, instances as they first appear, seconds per stage.

    capture: the fitted scene. cloud: the result.
    """
    scene, appeared = LabelledScene.from_cloud(cloud), np.zeros(len(cloud.instances), bool)
    with rerun_sink(path) as sink:
        for stage in cloud.provenance.get("stages", []):
            sink.text(f"{stage['name']}: {stage['seconds']:.2f} s")
        for entry in cloud.provenance.get("left_out", []):
            sink.text(f"left out: {entry['what']}: {entry['why']}")
        sink.instances(0, scene, appeared)
        for step, view in enumerate(Journal(progress).steps(capture.views, "rerun")):
            sink.frame(step, view.camera, view.image_rgb(), view.mask_map())
            # An instance appears with the first view in which a point of it is in front.
            front = front_points(cloud, in_world(view.camera, capture.points.origin))
            seen = np.unique(cloud.instance_ids[front[front != NO_POINT]])
            new = seen[seen >= 0]
            if not appeared[new].all():
                appeared[new] = True
                sink.instances(step, scene, appeared)
