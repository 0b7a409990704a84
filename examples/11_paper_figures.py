"""The paper's figures by its own method: features as colors, and an object clicked, taken out and painted.

python examples/11_paper_figures.py CAPTURE WORD -o OUT    writes features.png and objects.png

objects.png has mode paper above the default mode. The click is on what the default mode calls WORD.
"""

import argparse
from pathlib import Path

import cv2
import numpy as np

import og_pointcloud as og
from og_pointcloud.fitting.fit import fit_prepared, prepare
from og_pointcloud.fitting.labellers import trained_by_rendering
from og_pointcloud.fitting.work_folder import WorkFolder
from og_pointcloud.formats.gaussian_ply import gaussian_rows
from og_pointcloud.formats.images import write_png
from og_pointcloud.formats.ply import write_ply
from og_pointcloud.journal import Journal
from og_pointcloud.scene import View
from og_pointcloud.settings import FitSettings, PaperSettings
from og_pointcloud.show.drawing import as_splats, draw
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

# Mode paper: a fit returns no features. Training with the same work folder continues from its last checkpoint.
settings = FitSettings(mode="paper", paper=PaperSettings(schedule_share=arguments.share))
journal = Journal(progress=True)
prepared = prepare(scene, settings, journal)
surface = prepared.surface
with WorkFolder.open(out / "training.work") as work:
    clouds = {"mode paper": fit_prepared(prepared, settings, journal, work)}
    features, book = trained_by_rendering(prepared.table, surface, settings, journal, work)
default = clouds["default"] = og.fit(scene)

# Features as colors in four views and from above, one row per stage; NaN, for points without features, is gray.
features, shown, leaves = map(surface.of_points, (features, book.leaf >= 0, book.centers[book.leaf]))
ids, of_instances = default.instance_ids, np.full_like(features, np.nan)
for k in np.unique(ids[shown & (ids >= 0)]):
    of_instances[ids == k] = features[shown & (ids == k)].mean(axis=0)
stages = {
    "mode paper: features": np.where(shown[:, None], features, np.nan),
    "mode paper: leaves of the codebook": np.where(shown[:, None], leaves, np.nan),
    "default: instances, in the mean color of their points": of_instances,
}
up = -np.mean([view.camera.world_to_camera[1, :3] for view in scene.views], axis=0)
viewpoint = choose_viewpoint(scene.points.xyz.astype(np.float64), shown, up / np.linalg.norm(up))
height, width = scene.views[0].camera.height, scene.views[0].camera.width
camera = viewpoint.camera(width, height, FOCAL * height / 2)
views = [scene.views[index] for index in np.linspace(0, len(scene.views) - 1, 4).astype(int)]
views.append(View("from above", camera, np.full((height, width), -1, np.int32), np.zeros((0, 1), np.float32)))
# Points are all drawn the same size: where strays lie far apart, the method's Gaussians are as large as furniture.
splats = as_splats(scene.points, default.spacing)
# The three principal directions of the features, three standard deviations wide each, become red, green and blue.
known = features[shown]
_, deviations, axes = np.linalg.svd(known - known.mean(axis=0), full_matrices=False)
to_rgb = axes[:3].T / np.maximum(3 * deviations[:3] / np.sqrt(len(known)), 1e-12)
small = [view.camera.resized(360, round(360 * height / width)) for view in views]
photographs = [
    np.full((height, width, 3), 255, np.uint8) if (image := view.image_rgb()) is None else image for view in views
]
rows = [
    np.hstack([cv2.resize(image, (lens.width, lens.height)) for image, lens in zip(photographs, small, strict=True)])
]
for title, of_points in stages.items():
    rgb = np.clip(255 * (0.5 + (of_points - known.mean(axis=0)) @ to_rgb), 0, 255)
    rgb = np.where(np.isnan(rgb), 128, rgb)
    drawn = (draw(splats, og.in_world(lens, scene.points.origin), rgb, near=surface.near) for lens in small)
    rows.append(np.hstack([*drawn]))
    cv2.putText(rows[-1], title, (10, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1, cv2.LINE_AA)
write_png(out / "features.png", np.vstack(rows))

# A click on the middle of the word's thing, in the view that shows most of it with its surroundings.
best = og.select(default, {arguments.word: words.vectors[words.names.index(arguments.word)]}).best
if best is None:
    raise SystemExit(f"the default way finds no {arguments.word}; take another of {', '.join(words.names)}")
cameras = [og.in_world(view.camera, scene.points.origin) for view in scene.views]
thing = og.pick(default, default.xyz_world[ids == best.instance][0])
masks = [thing.mask(camera) for camera in cameras]
# Pixels count a tenth in a view that cuts the thing off at its border.
inside = [mask[1:-1, 1:-1].sum() == mask.sum() for mask in masks]
most = int(np.argmax([mask.sum() * (1 if whole else 0.1) for mask, whole in zip(masks, inside, strict=True)]))
camera, inner = cameras[most], cv2.distanceTransform(np.pad(masks[most], 1).astype(np.uint8), cv2.DIST_L2, 3)
row, column = (int(index) - 1 for index in np.unravel_index(inner.argmax(), inner.shape))

before = out / "before.ply"
write_ply(before, {"vertex": gaussian_rows(splats)})
sheet = []
for name, cloud in clouds.items():
    click = og.pick(cloud, camera, (column + 0.5, row + 0.5))
    print(f"{name}: {len(cloud.instances)} instances, clicked {click}")
    panels = [draw(og.read_points(before), camera, near=surface.near)]
    if click.found:
        gone, painted = (out / f"{name.replace(' ', '_')}_{what}.ply" for what in ("gone", "painted"))
        og.edit.remove(cloud, click, gone, cloud=before, halo=3)
        og.edit.recolor(cloud, click, painted, (40, 70, 220), cloud=before)
        panels += [draw(og.read_points(file), camera, near=surface.near) for file in (gone, painted)]
        lit = click.mask(camera)[:, :, None]
        panels[0] = np.where(lit, 0.4 * panels[0] + [138, 24, 36], 0.35 * panels[0] + 150).astype(np.uint8)
    cv2.drawMarker(panels[0], (column, row), (0, 0, 0), cv2.MARKER_CROSS, 24, 3)
    cv2.putText(panels[0], name, (10, 30), cv2.FONT_HERSHEY_SIMPLEX, 0.9, (0, 0, 0), 2, cv2.LINE_AA)
    sheet.append(np.hstack([*panels, *[np.full_like(panels[0], 255)] * (3 - len(panels))]))
write_png(out / "objects.png", np.vstack(sheet))
