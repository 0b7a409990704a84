"""Scene editing by words on a made room: sofa and cushions removed, the table red, one more chair.

python examples/edit_scene.py -o OUT    writes edit_scene.png and the four 3DGS files shown in it
"""

import argparse
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from og_pointcloud_room.capture import CaptureSettings, make_capture, write_capture
from og_pointcloud_room.furniture import CLASS_NAMES

import og_pointcloud as og
from og_pointcloud.cloud import Vocabulary
from og_pointcloud.fitting.fit import prepare
from og_pointcloud.fitting.visibility import Gaussians, render
from og_pointcloud.formats.gaussian_ply import write_gaussian_ply

parser = argparse.ArgumentParser(description="Scene editing by words on a made room.")
parser.add_argument("-o", "--output", type=Path, default=Path("out/edit"), metavar="OUT", help="folder")
out = parser.parse_args().output

capture = make_capture(0, CaptureSettings(views=40))
room = og.read_capture(write_capture(capture, out / "capture"))
prepared = prepare(room)
cloud = replace(og.fit(room, prepared=prepared), vocabulary=Vocabulary(CLASS_NAMES, capture.text_vectors))
scene = og.load(og.write_bundle(cloud, out / "room.ogpc"))
splats = prepared.gaussians  # twice as large as the fit draws them, so that a picture has no gaps
before, removed, recoloured, inserted = (
    out / f"{name}.ply" for name in ("before", "removed", "recoloured", "inserted")
)
shape = {"scale": 2 * splats.scale, "rotation": splats.rotation, "opacity": splats.opacity}
write_gaussian_ply(before, replace(room.points, **shape))

sofas, cushions = og.select(scene, "sofa").instances, og.select(scene, "cushion").instances
og.edit.remove(scene, [*sofas, *cushions], removed, cloud=before, halo=3)
tables = og.edit.recolour(scene, "table", recoloured, (170, 40, 35), cloud=removed).instances
chairs = og.edit.extract(scene, og.select(scene, "chair")[0], out / "chair.ply", cloud=before).instances
instances = og.instance_table(scene)
sofa, table, chair = (np.asarray(instances[ids[0]].centroid)[:2] for ids in (sofas, tables, chairs))
pose = np.eye(4)  # the copy stands in the middle of where the sofa was, turned by a right angle
pose[:2, :2] = [[0, -1], [1, 0]]
pose[:2, 3] = sofa - pose[:2, :2] @ chair
og.edit.insert(recoloured, out / "chair.ply", inserted, pose)

eye = np.append(table + 1.6 * (table - sofa) / np.linalg.norm(table - sofa), 2.2)
forward = np.append(sofa, 0.4) - eye
forward /= np.linalg.norm(forward)
right = np.cross(forward, [0, 0, 1]) / np.linalg.norm(forward[:2])
rotation = np.stack([right, np.cross(forward, right), forward])
world_to_camera = np.vstack([np.column_stack([rotation, -rotation @ eye]), [0, 0, 0, 1]])
camera = og.Camera(640, 480, 420, 420, 320, 240, world_to_camera)
pictures = []
for path in (before, removed, recoloured, inserted):
    points = og.read_points(path)
    rgb = np.asarray(points.rgb, np.float32)
    image, covered = render(Gaussians.from_points(points), rgb, og.in_world(camera, -points.origin), near=0.1)
    pictures.append(np.clip(image + 255 * (1 - covered[..., None]), 0, 255).astype(np.uint8)[:, :, ::-1])
cv2.imwrite(str(out / "edit_scene.png"), np.vstack([np.hstack(pictures[:2]), np.hstack(pictures[2:])]))
