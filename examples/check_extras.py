"""Each extra alone: a fresh environment with it and nothing more; what imports, and what the others say.

python examples/check_extras.py [-o extras.md] [EXTRA ...]    takes minutes: it installs every extra that is named
"""

import argparse
import subprocess
import sys
import tempfile
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
EXTRAS = ("", "open3d", "pyvista", "ros", "las", "trimesh")
TRIED = """
import numpy as np, sys
import og_pointcloud as og

zeros = np.zeros(2, np.int32)
reasons = np.zeros(2, np.int8)
result = og.Segmentation(np.eye(3)[:2], zeros, np.ones(2, np.float32), zeros, ("cup",), None, reasons, reasons)
folder = sys.argv[1]


def trimesh_in():
    import trimesh
    from og_pointcloud.ask.hosts import world_points
    assert world_points(trimesh.PointCloud(np.eye(3))).shape == (3, 3)


uses = {
    "open3d": result.to_open3d,
    "pyvista": result.to_pyvista,
    "ros": result.to_pointcloud2,
    "las": lambda: result.save(folder + "/out.laz"),
    "trimesh": trimesh_in,
    "fit": lambda: og.write_bundle,
    "glTF": lambda: result.save(folder + "/out.glb"),
}
for name, use in uses.items():
    try:
        use()
    except ImportError as error:
        print(name, str(error), sep="\\t")
    else:
        print(name, "works", sep="\\t")
"""


def answers(extra: str) -> dict[str, str]:
    """Use -> "works" or what it says, in an environment with that extra alone."""
    with tempfile.TemporaryDirectory() as folder:
        venv.create(folder, with_pip=True)
        python = Path(folder) / "bin" / "python"
        target = f"{ROOT}[{extra}]" if extra else str(ROOT)
        subprocess.run([python, "-m", "pip", "install", "-q", target], check=True)
        done = subprocess.run([python, "-c", TRIED, folder], capture_output=True, text=True, cwd=folder)
        if done.returncode:
            sys.exit(f"with '{extra}': {done.stderr}")
        return dict(line.split("\t", 1) for line in done.stdout.splitlines())


parser = argparse.ArgumentParser(description="Each extra alone: what imports, and what the others say.")
parser.add_argument("extras", nargs="*", default=EXTRAS, metavar="EXTRA", help="of pyproject.toml (default: all hosts)")
parser.add_argument("-o", "--output", type=Path, metavar="TABLE.md")
arguments = parser.parse_args()

lines = ["| installed | use | answer |", "| --- | --- | --- |"]
for extra in arguments.extras:
    lines += [f"| {extra or 'base'} | {use} | {answer} |" for use, answer in answers(extra).items()]
table = "\n".join(lines)
print(table)
if arguments.output:
    arguments.output.write_text(table + "\n")
