"""A .laz in; labelled .laz and .glb out; both read back by other people's libraries. Needs laspy and trimesh.

python examples/06_las_and_gltf.py street.ogpc street.laz --labels car,tree -o street_labels
"""

import argparse
import json
from pathlib import Path

import laspy
import trimesh

import og_pointcloud as og

parser = argparse.ArgumentParser(description="A .laz in; labelled .laz and .glb out.")
parser.add_argument("scene", metavar="S.ogpc", help="what `og-pointcloud fit` wrote")
parser.add_argument("cloud", metavar="CLOUD.laz", help="a .las or .laz of the same place, in the scene's frame")
parser.add_argument("--labels", required=True, metavar="A,B,C")
parser.add_argument(
    "-o", "--output", type=Path, default=Path("labelled"), metavar="NAME", help="path without an ending"
)
arguments = parser.parse_args()

result = og.segment(arguments.cloud, arguments.labels.split(","), arguments.scene)
laz = result.save(arguments.output.with_suffix(".laz"))
glb = result.save(arguments.output.with_suffix(".glb"))

# A survey tool filters by classification; a program reads the extra bytes.
las = laspy.read(laz)
record = las.header.vlrs.get_by_id("og_pointcloud")[0]
names = json.loads(record.record_data_bytes())
for label, name in enumerate(names):
    print(f"{name}: {(las.og_label == label).sum()} points, class {64 + label}")

# The .glb opens anywhere as a cloud of colored points; here it is labelled again, in the same coordinates.
again = og.segment(trimesh.load_scene(glb).to_geometry(), names, arguments.scene)
print(f"{(again.labels == result.labels).mean():.2%} of labels agree after a round trip through float32")
print(f"wrote {laz} and {glb}")
