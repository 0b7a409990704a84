"""Label a cloud by words: the same answer as arrays, and as a PyVista dataset that is drawn in categories.

python examples/01_label_a_cloud.py room.ogpc --labels chair,table,sofa -o OUT    writes labels.png and labels.vtp
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import pyvista as pv
from og_pointcloud_pyvista import can_render

import og_pointcloud as og

parser = argparse.ArgumentParser(description="Label a cloud by words.")
parser.add_argument("scene", type=Path, metavar="S.ogpc", help="what `og-pointcloud fit` or `demo` wrote")
parser.add_argument("--labels", metavar="A,B,C", help="default: all words that the scene knows")
parser.add_argument("-o", "--output", type=Path, default=Path("out/01"), metavar="OUT", help="folder")
arguments = parser.parse_args()
labels = arguments.labels.split(",") if arguments.labels else None
arguments.output.mkdir(parents=True, exist_ok=True)

# Any points in the scene's frame, here its own with a little noise: each gets a label, a score and an instance.
scene = og.load(arguments.scene)
points = scene.xyz + np.random.default_rng(0).normal(scale=0.2 * scene.cloud.spacing, size=scene.xyz.shape)
result = og.segment(points, labels, scene)
for name, count in result.counts().items():
    if count:
        print(f"{name:20} {count:9,} points, mean score {result.scores[result.mask(name)].mean():.2f}")
print("unknown:", ", ".join(f"{count:,} {reason}" for reason, count in result.unknown_because().items()))

# The same from PyVista: nothing to import, og_pointcloud is found through its entry points.
mesh: Any = pv.PolyData(points).og.segment(labels, scene)
if scene.cloud.rgb is not None:
    mesh["RGB"] = scene.cloud.rgb  # a dataset's own colors shade the label colors
assert np.array_equal(mesh["og_label"], result.labels)
mesh.save(arguments.output / "labels.vtp")  # names and the scene's path travel with it

if not can_render():
    raise SystemExit("VTK cannot draw here: install libegl1 or libosmesa6")
plotter: Any = pv.Plotter(off_screen=True, window_size=[1400, 900])
plotter.og.add_segmentation(mesh, point_size=4)
plotter.og.show_labelled(mesh)
plotter.screenshot(arguments.output / "labels.png")
print(f"wrote {arguments.output}/labels.vtp and labels.png")
