"""Click query: before, and after a click on an instance, as a mouse would click.

python examples/03_click_query.py room.ogpc -o OUT    writes before.png and after.png
python examples/03_click_query.py room.ogpc --show    opens the window: click yourself
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import pyvista as pv
from og_pointcloud_pyvista import can_render

import og_pointcloud as og

parser = argparse.ArgumentParser(description="Click on a scene: what is it?")
parser.add_argument("scene", type=Path, metavar="S.ogpc", help="what `og-pointcloud fit` or `demo` wrote")
parser.add_argument("-o", "--output", type=Path, default=Path("out/03"), metavar="OUT", help="folder")
parser.add_argument("--show", action="store_true", help="open a window")
arguments = parser.parse_args()
if not arguments.show and not can_render():
    raise SystemExit("VTK cannot draw here: install libegl1 or libosmesa6")
arguments.output.mkdir(parents=True, exist_ok=True)

scene = og.load(arguments.scene)
mesh = pv.read(arguments.scene).og.segment()
plotter: Any = pv.Plotter(off_screen=not arguments.show, window_size=[1200, 900])
plotter.og.add_segmentation(mesh, point_size=4)
clicks = []
plotter.og.enable_click_query(scene, callback=clicks.append)
plotter.og.show_labelled(mesh)
if arguments.show:
    plotter.show()
    raise SystemExit

# Click on the frontmost point of the largest instance that nothing hides there.
plotter.show(auto_close=False)
plotter.screenshot(arguments.output / "before.png")
toward_eye = np.asarray(plotter.camera.position) - np.asarray(plotter.camera.focal_point)
for row in scene.instances.largest():
    front = row.xyz[(row.xyz @ toward_eye).argmax()]
    plotter.renderer.SetWorldPoint(*front, 1)
    plotter.renderer.WorldToDisplay()
    pixel = np.rint(plotter.renderer.GetDisplayPoint()[:2]).astype(int).tolist()
    plotter.iren._mouse_left_button_click(*pixel)
    if clicks and clicks[-1].found:
        print(f"click at {pixel}: {clicks[-1]}, {clicks[-1].words()[:3]}")
        break
plotter.screenshot(arguments.output / "after.png")
print(f"wrote {arguments.output}/before.png and after.png")
