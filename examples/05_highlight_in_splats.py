"""A word highlighted in a rendering of 3D Gaussians. Needs Open3D 0.20.

python examples/05_highlight_in_splats.py kitchen.ogpc kitchen_3dgs.ply mug -o mug.png --eye 2,-2,2 --target 0,0,0.5
"""

import argparse
from pathlib import Path

import og_pointcloud_open3d as og3

import og_pointcloud as og


def numbers(text: str) -> list[float]:
    """x,y,z as three numbers."""
    return [float(part) for part in text.split(",")]


parser = argparse.ArgumentParser(description="A word highlighted in a rendering of 3D Gaussians.")
parser.add_argument("scene", metavar="S.ogpc", help="what `og-pointcloud fit` wrote")
parser.add_argument("splats", metavar="SPLATS.ply", help="a 3DGS file of the same place")
parser.add_argument("word", metavar="WORD")
parser.add_argument("--eye", type=numbers, metavar="X,Y,Z", help="where to look from; left out: obliquely from above")
parser.add_argument("--target", type=numbers, default=[0.0, 0.0, 0.0], metavar="X,Y,Z", help="where to look at")
parser.add_argument("-o", "--output", type=Path, default=Path("highlight.png"), metavar="P.png")
arguments = parser.parse_args()

scene = og.load(arguments.scene)
print(og.select(scene, arguments.word))
camera = og3.look_at(arguments.eye, arguments.target, size=(640, 480)) if arguments.eye else None
picture = og3.highlight_png(arguments.output, arguments.splats, arguments.word, scene, camera=camera)
print(f"wrote {picture}")
