"""A word highlighted in a rendering of 3D Gaussians.

python examples/05_highlight_in_splats.py kitchen.ogpc kitchen_3dgs.ply mug -o mug.png --eye=2,-2,2 --target=0,0,0.5
"""

import argparse
from pathlib import Path

import numpy as np

import og_pointcloud as og
from og_pointcloud.formats.colors import LUMINANCE
from og_pointcloud.formats.images import write_png
from og_pointcloud.show.drawing import draw
from og_pointcloud.show.viewpoint import Viewpoint


def numbers(text: str) -> np.ndarray:
    """x,y,z as three numbers."""
    return np.array([float(part) for part in text.split(",")])


parser = argparse.ArgumentParser(description="A word highlighted in a rendering of 3D Gaussians.")
parser.add_argument("scene", metavar="S.ogpc", help="what `og-pointcloud fit` wrote")
parser.add_argument("splats", metavar="SPLATS.ply", help="a 3DGS file of the same place")
parser.add_argument("word", metavar="WORD")
parser.add_argument("--eye", type=numbers, required=True, metavar="X,Y,Z", help="where to look from")
parser.add_argument("--target", type=numbers, required=True, metavar="X,Y,Z", help="where to look at")
parser.add_argument("-o", "--output", type=Path, default=Path("highlight.png"), metavar="P.png")
arguments = parser.parse_args()

scene, splats = og.load(arguments.scene), og.read_points(arguments.splats)
selection = og.select(scene, arguments.word)
print(selection)

# Each Gaussian takes the instance of the nearest point; instances that fit the word turn red, the rest light gray.
found = np.isin(scene.instances_at(splats.xyz_world), selection.instances)
rgb = np.asarray(splats.rgb, np.float32)
pale = 150 + 0.35 * (rgb @ LUMINANCE)[:, None].repeat(3, axis=1)
colors = np.where(found[:, None], 0.4 * rgb + 0.6 * np.array([230, 40, 60]), pale)

view = Viewpoint(arguments.eye, arguments.target, np.array([0.0, 0, 1]))
write_png(arguments.output, draw(splats, view.camera(640, 480, 420), colors))
print(f"wrote {arguments.output}")
