"""Instances and boxes: what a scene is made of, as a table, as blocks of a PyVista MultiBlock, and as a picture.

python examples/02_instances_and_boxes.py room.ogpc -o OUT    writes instances.csv and instances.png
"""

import argparse
from pathlib import Path
from typing import Any

import pyvista as pv
from og_pointcloud_pyvista import can_render

import og_pointcloud as og

parser = argparse.ArgumentParser(description="Instances and boxes of a scene.")
parser.add_argument("scene", type=Path, metavar="S.ogpc", help="what `og-pointcloud fit` or `demo` wrote")
parser.add_argument("-o", "--output", type=Path, default=Path("out/02"), metavar="OUT", help="folder")
arguments = parser.parse_args()
arguments.output.mkdir(parents=True, exist_ok=True)

# The table: where each instance is, its size, what it looks like; boxes are upright along z.
table = og.instance_table(arguments.scene, up=(0, 0, 1))
print(table)
table.to_csv(arguments.output / "instances.csv")

# The same as datasets: PyVista's own method makes one block per instance, here named by its id.
mesh: Any = pv.read(arguments.scene).og.segment()
blocks = mesh.split_values({str(row.id): row.id for row in table if row.points}, scalars="og_instance")
largest = max(blocks.keys(), key=lambda name: blocks[name].n_points)
print(f"{blocks.n_blocks} blocks; the largest is instance {largest} of {blocks[largest].n_points:,} points")

if not can_render():
    raise SystemExit("VTK cannot draw here: install libegl1 or libosmesa6")
plotter: Any = pv.Plotter(off_screen=True, window_size=[1800, 900], shape=(1, 2))
plotter.og.add_segmentation(mesh, by="instance", point_size=4, legend=False)
plotter.add_text("by instance", font_size=12)
plotter.subplot(0, 1)
plotter.og.add_segmentation(mesh, point_size=4, names=False, name="by label")
plotter.og.add_boxes(mesh, up=(0, 0, 1), line_width=4)
plotter.add_text("by label, with boxes", font_size=12)
plotter.link_views()
plotter.og.show_labelled(mesh)
plotter.screenshot(arguments.output / "instances.png")
print(f"wrote {arguments.output}/instances.csv and instances.png")
