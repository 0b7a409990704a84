"""The paper's figures by its own method: features as colors, and an object clicked, taken out and painted.

python examples/11_paper_figures.py CAPTURE WORD -o OUT    writes features.png and objects.png

objects.png has mode paper above the default way. The click is on what the default way calls WORD.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

import og_pointcloud as og
from og_pointcloud.fitting.fit import fit_prepared, prepare
from og_pointcloud.fitting.labellers import trained_by_rendering
from og_pointcloud.fitting.work_folder import WorkFolder
from og_pointcloud.formats.gaussian_ply import gaussian_rows
from og_pointcloud.formats.ply import write_ply
from og_pointcloud.journal import Journal
from og_pointcloud.rendering.geometry import isotropic
from og_pointcloud.rendering.splatting import Gaussians, render
from og_pointcloud.scene import View
from og_pointcloud.settings import FitSettings, PaperSettings
from og_pointcloud.show.viewpoint import FOCAL, choose_viewpoint

parser = argparse.ArgumentParser(description="The paper's figures by its own method.")
parser.add_argument("capture", type=Path, metavar="CAPTURE", help="a capture with text_features.npz")
parser.add_argument("word", metavar="WORD", help="what is clicked, taken out and painted")
parser.add_argument("--share", type=float, default=0.167, help="of the published schedule (default: %(default)s)")
parser.add_argument("-o", "--output", type=Path, default=Path("out/11"), metavar="OUT", help="folder")
arguments = parser.parse_args()
out = arguments.output
out.mkdir(parents=True, exist_ok=True)
scene = og.read_capture(arguments.capture)
words, _ = og.read_text_features(arguments.capture / "text_features.npz")

# Mode paper: a fit returns no features. Training again with the same work folder finds the checkpoint of the last step.
settings = FitSettings(mode="paper", paper=PaperSettings(schedule_share=arguments.share))
journal = Journal(progress=True)
prepared = prepare(scene, settings, journal)
table, surface = prepared.table, prepared.surface
with WorkFolder.open(out / "training.work") as work:
    clouds = {"mode paper": fit_prepared(prepared, settings, journal, work)}
    features, book = trained_by_rendering(table, surface, settings, journal, work)
clouds["default"] = og.fit(scene)

# Features as colors in four views, and as points seen from above.
xyz, shown = surface.scene.points.xyz, book.leaf >= 0
of_scene = surface.of_points(features), surface.of_points(shown)
instance = clouds["default"].instance_ids
known = of_scene[1] & (instance >= 0)
# The last row stays NaN, which is drawn as nothing: for points without an instance.
means = np.full((instance.max(initial=0) + 2, features.shape[1]), np.nan, np.float32)
for number in np.unique(instance[known]):
    means[number] = of_scene[0][known & (instance == number)].mean(axis=0)
rows = surface.row_of_point
of_default = np.full_like(features, np.nan)
of_default[slice(None) if rows is None else rows] = means[np.maximum(instance, -1)]
stages = {
    "mode paper: features": np.where(shown[:, None], features, np.nan),
    "mode paper: leaves of the codebook": np.where(shown[:, None], book.centers[book.leaf], np.nan),
    "default: instances, in the mean color of their points": of_default,
}
up = -np.mean([view.camera.world_to_camera[1, :3] for view in scene.views], axis=0)
viewpoint = choose_viewpoint(xyz.astype(np.float64), shown, up / np.linalg.norm(up))
height, width = scene.views[0].camera.height, scene.views[0].camera.width
camera = viewpoint.camera(width, height, FOCAL * height / 2)
views = [scene.views[index] for index in np.linspace(0, len(scene.views) - 1, 4).astype(int)]
from_above = View("from above", camera, np.full((height, width), -1, np.int32), np.zeros((0, 1), np.float32))
# Points are drawn all alike: where strays lie far apart, the Gaussians of the method are as large as furniture.
splats = isotropic(surface.scene.points, np.full(len(xyz), np.median(surface.neighbourhood.spacing)), 0.7, 0.95)
og.feature_picture(splats, [*views, from_above], surface.near, stages, out / "features.png", columns=5)

# A click on the middle of the word's thing, in the view that shows most of it and all that lies around it.
best = og.select(clouds["default"], {arguments.word: words.vectors[words.names.index(arguments.word)]}).best
if best is None:
    raise SystemExit(f"the default way finds no {arguments.word}; take another of {', '.join(words.names)}")
origin = scene.points.origin
thing = og.pick(clouds["default"], clouds["default"].xyz_world[instance == best.instance][0])
masks = [thing.mask(og.in_world(view.camera, origin)) for view in scene.views]
# A view that cuts the thing off at its border counts a tenth of its pixels.
cut = [np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]]).any() for mask in masks]
most = int(np.argmax([mask.sum() * (0.1 if off else 1) for mask, off in zip(masks, cut, strict=True)]))
inner = cv2.distanceTransform(np.pad(masks[most], 1).astype(np.uint8), cv2.DIST_L2, 3)[1:-1, 1:-1]
row, column = np.unravel_index(inner.argmax(), inner.shape)
camera = og.in_world(scene.views[most].camera, origin)

points = replace(surface.scene.points, scale=splats.scale, rotation=splats.rotation, opacity=splats.opacity)
write_ply(out / "before.ply", {"vertex": gaussian_rows(points)})


def drawn(path: Path) -> np.ndarray:
    """A splat file as the clicked view shows it, BGR."""
    points = og.read_points(path)
    of_view = og.in_world(camera, -points.origin)
    image, covered = render(Gaussians.from_points(points), np.asarray(points.rgb, np.float32), of_view, surface.near)
    return np.clip(image + 255 * (1 - covered[..., None]), 0, 255).astype(np.uint8)[:, :, ::-1]


sheet = []
for name, cloud in clouds.items():
    click = og.pick(cloud, camera, (column + 0.5, row + 0.5))
    print(f"{name}: {len(cloud.instances)} instances, clicked {click}")
    panels = [drawn(out / "before.ply")]
    if click.found:
        file = out / f"{name.replace(' ', '_')}.ply"
        og.edit.remove(cloud, click, file, cloud=out / "before.ply", halo=3)
        panels.append(drawn(file))
        og.edit.recolour(cloud, click, file, (40, 70, 220), cloud=out / "before.ply")
        panels.append(drawn(file))
        lit = click.mask(camera)[:, :, None]
        panels[0] = np.where(lit, 0.4 * panels[0] + [36, 24, 138], 0.35 * panels[0] + 150).astype(np.uint8)
    cv2.drawMarker(panels[0], (int(column), int(row)), (0, 0, 0), cv2.MARKER_CROSS, 24, 3)
    panels += [np.full_like(panels[0], 255)] * (3 - len(panels))
    cv2.putText(panels[0], name, (10, 30), cv2.FONT_HERSHEY_SIMPLEX, 0.9, (0, 0, 0), 2, cv2.LINE_AA)
    sheet.append(np.hstack(panels))
cv2.imwrite(str(out / "objects.png"), np.vstack(sheet))
