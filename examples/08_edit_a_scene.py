"""Scene editing by words: sofa and cushions removed, the table red, one more chair; before and after as splats.

python examples/08_edit_a_scene.py room.ogpc -o OUT    writes edited.png and the four 3DGS files shown in it
"""

import argparse
from pathlib import Path

import numpy as np

import og_pointcloud as og
from og_pointcloud.formats.gaussian_ply import gaussian_rows
from og_pointcloud.formats.images import write_png
from og_pointcloud.formats.ply import write_ply
from og_pointcloud.scene import Points
from og_pointcloud.show.drawing import as_splats, draw
from og_pointcloud.show.viewpoint import Viewpoint

parser = argparse.ArgumentParser(description="Scene editing by words.")
parser.add_argument("scene", type=Path, metavar="S.ogpc", help="what `og-pointcloud demo` wrote")
parser.add_argument("-o", "--output", type=Path, default=Path("out/08"), metavar="OUT", help="folder")
arguments = parser.parse_args()
out = arguments.output
out.mkdir(parents=True, exist_ok=True)
scene = og.load(arguments.scene)
files = before, removed, recolored, inserted = [out / f"{n}.ply" for n in ("before", "removed", "red", "inserted")]

# The room as splats: round Gaussians as large as the point spacing. A trained 3DGS file would do as well.
cloud = scene.cloud
splats = as_splats(Points(cloud.xyz, cloud.origin, cloud.rgb), cloud.spacing)
write_ply(before, {"vertex": gaussian_rows(splats)})

# Each edit reads a file and writes the next. halo: points without an instance this near are removed too.
sofas, cushions = og.select(scene, "sofa").instances, og.select(scene, "cushion").instances
og.edit.remove(scene, [*sofas, *cushions], removed, cloud=before, halo=3)
tables = og.edit.recolor(scene, "table", recolored, (170, 40, 35), cloud=removed).instances
chairs = og.edit.extract(scene, og.select(scene, "chair")[0], out / "chair.ply", cloud=before).instances
sofa, table, chair = (np.asarray(scene.instances[ids[0]].centroid)[:2] for ids in (sofas, tables, chairs))
pose = np.eye(4)  # the copy is placed where the sofa's middle was, turned by 90 degrees
pose[:2, :2] = [[0, -1], [1, 0]]
pose[:2, 3] = sofa - pose[:2, :2] @ chair
og.edit.insert(recolored, out / "chair.ply", inserted, pose)

# The four files from one viewpoint, looking across the table to where the sofa was.
eye = np.append(table + 1.6 * (table - sofa) / np.linalg.norm(table - sofa), 2.2)
camera = Viewpoint(eye, np.append(sofa, 0.4), np.array([0.0, 0, 1])).camera(640, 480, 420)
pictures = [draw(og.read_points(file), camera) for file in files]
write_png(out / "edited.png", np.vstack([np.hstack(pictures[:2]), np.hstack(pictures[2:])]))
print(f"removed {len(sofas) + len(cushions)} instances, recolored {len(tables)}, wrote {out / 'edited.png'}")
