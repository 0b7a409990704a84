"""Scene editing by words: sofa and cushions removed, the table red, one more chair; before and after as splats.

python examples/08_edit_a_scene.py room.ogpc -o OUT    writes edited.png and the four 3DGS files shown in it
"""

import argparse
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

import og_pointcloud as og
from og_pointcloud.formats.gaussian_ply import gaussian_rows
from og_pointcloud.formats.ply import write_ply
from og_pointcloud.rendering.geometry import isotropic
from og_pointcloud.rendering.splatting import Gaussians, render
from og_pointcloud.scene import Points
from og_pointcloud.show.viewpoint import Viewpoint

parser = argparse.ArgumentParser(description="Scene editing by words.")
parser.add_argument("scene", type=Path, metavar="S.ogpc", help="what `og-pointcloud demo` wrote")
parser.add_argument("-o", "--output", type=Path, default=Path("out/08"), metavar="OUT", help="folder")
arguments = parser.parse_args()
out = arguments.output
out.mkdir(parents=True, exist_ok=True)
scene = og.load(arguments.scene)

# The room as a splat: round Gaussians as large as the points are apart. A trained 3DGS file would do as well.
points = Points(scene.cloud.xyz, scene.cloud.origin, scene.cloud.rgb)
splats = isotropic(points, np.full(len(points), scene.cloud.spacing, np.float32), 0.7, 0.95)
files = before, removed, recoloured, inserted = [out / f"{n}.ply" for n in ("before", "removed", "red", "inserted")]
gaussians = replace(points, scale=splats.scale, rotation=splats.rotation, opacity=splats.opacity)
write_ply(before, {"vertex": gaussian_rows(gaussians)})

# Each edit reads a file and writes the next. halo: points without an instance this near go along with what is removed.
sofas, cushions = og.select(scene, "sofa").instances, og.select(scene, "cushion").instances
og.edit.remove(scene, [*sofas, *cushions], removed, cloud=before, halo=3)
tables = og.edit.recolour(scene, "table", recoloured, (170, 40, 35), cloud=removed).instances
chairs = og.edit.extract(scene, og.select(scene, "chair")[0], out / "chair.ply", cloud=before).instances
sofa, table, chair = (np.asarray(scene.instances[ids[0]].centroid)[:2] for ids in (sofas, tables, chairs))
pose = np.eye(4)  # the copy stands in the middle of where the sofa was, turned by a right angle
pose[:2, :2] = [[0, -1], [1, 0]]
pose[:2, 3] = sofa - pose[:2, :2] @ chair
og.edit.insert(recoloured, out / "chair.ply", inserted, pose)

# The four files from one viewpoint, across the table towards where the sofa was.
eye = np.append(table + 1.6 * (table - sofa) / np.linalg.norm(table - sofa), 2.2)
camera = Viewpoint(eye, np.append(sofa, 0.4), np.array([0.0, 0, 1])).camera(640, 480, 420)
pictures = []
for path in files:
    splat = og.read_points(path)
    image, covered = render(
        Gaussians.from_points(splat), np.asarray(splat.rgb, np.float32), og.in_world(camera, -splat.origin), near=0.1
    )
    pictures.append(np.clip(image + 255 * (1 - covered[..., None]), 0, 255).astype(np.uint8)[:, :, ::-1])
cv2.imwrite(str(out / "edited.png"), np.vstack([np.hstack(pictures[:2]), np.hstack(pictures[2:])]))
print(f"removed {len(sofas) + len(cushions)} instances, recoloured {len(tables)}, wrote {out / 'edited.png'}")
