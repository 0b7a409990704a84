"""How sure is each point: what a threshold keeps, and where views and neighbors disagree, as a picture."""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import pyvista as pv
from og_pointcloud_pyvista import can_render

import og_pointcloud as og

parser = argparse.ArgumentParser(description="How sure each point's instance is.")
parser.add_argument("scene", type=Path, metavar="S.ogpc", help="what `og-pointcloud fit` or `demo` wrote")
parser.add_argument("--at-least", type=float, default=0.5, metavar="C", help="certainty that is kept (default: 0.5)")
parser.add_argument("-o", "--output", type=Path, default=Path("out/09"), metavar="OUT", help="folder")
arguments = parser.parse_args()
arguments.output.mkdir(parents=True, exist_ok=True)

# Scores tell whether the word fits an instance, certainty whether the point is part of that instance.
result = og.segment(arguments.scene)
if result.certainty is None:
    raise SystemExit(f"{arguments.scene} does not know how sure its points are: fit the capture again")
sure = result.certainty >= arguments.at_least
print(f"{'label':20} {'points':>9} {'of these sure':>14}")
for number, name in enumerate(result.names):
    labelled = result.labels == number
    if labelled.any():
        print(f"{name:20} {labelled.sum():9,} {sure[labelled].mean():14.1%}")

if not can_render():
    raise SystemExit("VTK cannot draw here: install libegl1 or libosmesa6")
mesh: Any = result.to_pyvista()
unsure: Any = mesh.copy()
unsure["og_label"] = np.where(sure, result.labels, -1)  # uncertain points become unknown
plotter: Any = pv.Plotter(off_screen=True, window_size=[1800, 900], shape=(1, 2))
bar = {"title": "certainty", "vertical": True, "fmt": "%.1f", "n_labels": 3}
plotter.add_mesh(pv.PolyData(mesh.points), scalars=result.certainty, clim=(0, 1), point_size=4, scalar_bar_args=bar)
plotter.subplot(0, 1)
plotter.og.add_segmentation(unsure, point_size=4, names=False)
plotter.add_text(f"labels of certainty {arguments.at_least:g} and more", font_size=12)
plotter.link_views()
plotter.og.show_labelled(unsure)
plotter.screenshot(arguments.output / "how_sure.png")
print(f"wrote {arguments.output}/how_sure.png")
