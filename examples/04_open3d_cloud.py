"""An Open3D cloud in, the same cloud painted by labels out.

python examples/04_open3d_cloud.py kitchen.ogpc points.ply --labels chair,table -o painted.ply
"""

import argparse
from pathlib import Path

import og_pointcloud_open3d as og3
import open3d as o3d

parser = argparse.ArgumentParser(description="An Open3D cloud in, the same cloud painted by labels out.")
parser.add_argument("scene", metavar="S.ogpc", help="what `og-pointcloud fit` wrote")
parser.add_argument("cloud", metavar="CLOUD", help="a cloud of the same place, in the scene's frame")
parser.add_argument("--labels", required=True, metavar="A,B,C")
parser.add_argument("-o", "--output", type=Path, default=Path("painted.ply"), metavar="P.ply")
arguments = parser.parse_args()

cloud = og3.read(arguments.cloud)  # raises an error with the reason where Open3D would return an empty cloud
painted, result = og3.segment(cloud, arguments.labels.split(","), arguments.scene)

# Open3D's own operations keep the labels: they are attributes (N, 1) of the tensor cloud.
thinned = painted.voxel_down_sample(0.05)
first = result.names[0]
mine = thinned.select_by_mask(thinned.point["og_label"].flatten() == 0)
print(f"{result.counts()}; {len(mine.point['positions'])} voxels of {first}")

o3d.t.io.write_point_cloud(arguments.output, painted)
print(f"wrote {arguments.output}; o3d.visualization.draw(painted) shows it")
