"""Has it become slower, or less exact? This tree against another revision, run in turn: `make bench [AGAINST=REV]`.

    python examples/bench.py                  # against HEAD if there are changes, else the last tag or HEAD~1
    python examples/bench.py --against v1.0 --rounds 9

The other revision is checked out into a temporary folder. Each round is a fresh process of A (the other), then one of B
(this tree), on the same files; the first round, which compiles, is discarded. It prints medians, the ratio B / A with
its range over the rounds, and the errors of both:

    kernel        one view of 100,000 Gaussians, seconds of one core; largest relative weight error against float64
    fit           a capture of a furnished room; 1 - adjusted Rand index against the room's own instances
    write         that fit as a .ogpc; share of points whose instance differs when it is read back
    first answer  import, load and label 1,000 points; share of instances that differ from the file's
    segment       300,000 points; share of instances that differ from those scipy's KD-tree finds
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
PIECES = ("kernel", "fit", "write", "first answer", "segment")
MEASURE = '''
"""One round of one revision, by public names: any revision has them. argv: folder of the files, folder for results."""
import importlib, json, sys, time
from pathlib import Path
import numpy as np
files, out = map(Path, sys.argv[1:])
seconds, error = {}, {}

def timed(name, work, runs=1, clock=time.perf_counter):
    taken = []
    for _ in range(runs):
        start = clock()
        answer = work()
        taken.append(clock() - start)
    seconds[name] = min(taken)
    return answer

def first_answer():
    import og_pointcloud as og
    scene = og.load(out / "first.ogpc")
    asked = scene.xyz[:: max(1, len(scene.xyz) // 1000)]
    words = {"thing": np.ones(scene.cloud.instances.descriptors.shape[1])}
    return og.Segmenter(scene, words)(asked).instances, scene

if (out / "first.ogpc").exists():  # not in the round that compiles
    found, scene = timed("first answer", first_answer)
    exact = scene.cloud.instance_ids[:: max(1, len(scene.xyz) // 1000)]
    error["first answer"] = float((found != exact).mean())
import og_pointcloud as og

cloud = timed("fit", lambda: og.fit(og.read_capture(files / "room"), progress=False))
np.save(out / "ids.npy", cloud.instance_ids)
timed("write", lambda: og.write_bundle(cloud, out / "room.ogpc"))
scene = og.load(out / "room.ogpc")
error["write"] = float((scene.cloud.instance_ids != cloud.instance_ids).mean())
(out / "room.ogpc").replace(out / "first.ogpc")

random = np.random.default_rng(0)
frame = cloud.xyz_world[random.integers(0, len(cloud), 300_000)]
frame = frame + 0.3 * cloud.spacing * random.normal(size=frame.shape)
segmenter = og.Segmenter(scene, {"thing": np.ones(cloud.instances.descriptors.shape[1])})
found = timed("segment", lambda: segmenter(frame).instances, runs=5)
from scipy.spatial import cKDTree
local = (frame - cloud.origin).astype(np.float32)
near = cKDTree(cloud.xyz).query(local, distance_upper_bound=cloud.reach, workers=-1)[1]
error["segment"] = float((found != np.append(cloud.instance_ids, og.TOO_FAR)[near]).mean())

for name in ("rendering", "fitting"):  # the one piece without a public name; its folder has moved
    try:
        splatting = importlib.import_module(f"og_pointcloud.{name}.splatting")
    except ImportError:
        continue
    import numba
    numba.set_num_threads(1)
    data = np.load(files / "kernel.npz")
    def draw(which):
        gaussians = splatting.Gaussians(*(data[f"{which}_{part}"] for part in ("xyz", "scale", "rotation", "opacity")))
        width, height, fx, fy, cx, cy = data[f"{which}_camera"].tolist()
        camera = og.Camera(int(width), int(height), fx, fy, cx, cy, np.eye(4))
        near, pixels = float(data["near"]), camera.width * camera.height
        if not hasattr(splatting, "ViewWeights"):
            return splatting.view_weights(gaussians, camera, near)
        ids = np.arange(pixels, dtype=np.int32).reshape(camera.height, camera.width)  # as it was called before
        return splatting.view_weights(gaussians, camera, ids, pixels, near).rows[:-1]
    draw("view")
    timed("kernel", lambda: draw("view"), runs=5, clock=time.process_time)
    error["kernel"] = float(np.abs(draw("window").toarray() - data["exact"]).max() / data["exact"].max())
    break
(out / "round.json").write_text(json.dumps([seconds, error]))
'''


def main(arguments: Sequence[str] | None = None) -> None:
    """Check out, measure in turn, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--against", metavar="REV", help="the other revision")
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args(arguments)
    revision = options.against or default_revision()
    with tempfile.TemporaryDirectory() as temporary:
        folder, other = Path(temporary), Path(temporary) / "other"
        git("worktree", "add", "--detach", str(other), revision)
        try:
            truth = write_files(folder / "files")
            print(f"A: {git('log', '-1', '--format=%h %s', revision)}\nB: this tree", flush=True)
            rounds = [[measure(tree, folder, truth) for tree in (other, ROOT)] for _ in range(options.rounds + 1)]
        finally:
            git("worktree", "remove", "--force", str(other))
    print_table([[dict(zip(("seconds", "error"), of, strict=True)) for of in both] for both in rounds[1:]])


def git(*arguments: str) -> str:
    """The output of git in this tree."""
    command = ["git", "-C", str(ROOT), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def default_revision() -> str:
    """HEAD if the tree has changes; else the last tag before it, or the previous commit."""
    if git("status", "--porcelain", "--untracked-files=no"):
        return "HEAD"
    return git("tag", "--merged", "HEAD~1", "--sort=-creatordate").partition("\n")[0] or "HEAD~1"


def write_files(folder: Path) -> np.ndarray:
    """Write what both revisions read: a room's capture, and a view for the kernel with its float64 result in a window.
    Returns the instance of each of the room's points."""
    from benchmark_visibility import Case, reference_of, room_case, window_of
    from og_pointcloud_room.capture import CaptureSettings, make_capture, write_capture

    capture = make_capture(0, CaptureSettings(views=20, width=480, height=360))
    write_capture(capture, folder / "room")
    view = room_case(100_000)
    window = window_of(view)

    def arrays(name: str, case: Case) -> dict[str, np.ndarray]:
        at = case.camera
        numbers = np.array([at.width, at.height, at.fx, at.fy, at.cx, at.cy])
        parts = {f"{name}_{part}": getattr(case.gaussians, part) for part in ("xyz", "scale", "rotation", "opacity")}
        return {**parts, f"{name}_camera": numbers}

    exact = {"exact": reference_of(window), "near": np.array(view.near)}
    np.savez(folder / "kernel.npz", **arrays("view", view), **arrays("window", window), **exact)
    return capture.instance


def measure(tree: Path, folder: Path, truth: np.ndarray) -> tuple[dict[str, float], dict[str, float]]:
    """Seconds and error of each piece, in a process that imports from this tree."""
    from og_pointcloud.evaluate.metrics import adjusted_rand_index

    out = folder / f"out-{tree.name}"
    out.mkdir(exist_ok=True)
    paths = (tree, tree / "export", tree / "plugins", tree / "examples")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, paths))}
    command = [sys.executable, "-c", MEASURE, str(folder / "files"), str(out)]
    subprocess.run(command, env=environment, cwd=folder, check=True)
    seconds, error = json.loads((out / "round.json").read_text())
    ids = np.load(out / "ids.npy")
    error["fit"] = 1 - adjusted_rand_index(ids[truth >= 0], truth[truth >= 0])
    return seconds, error


def print_table(rounds: Sequence[Sequence[dict[str, dict[str, float]]]]) -> None:
    """One row per piece. rounds: for each of A and B "seconds" and "error" by piece."""
    print(f"{'':<14} {'A, s':>9} {'B, s':>9} {'B / A':>6} {'range':>12} {'A, error':>9} {'B, error':>9}")
    for name in PIECES:
        if not all(name in of["seconds"] for both in rounds for of in both):
            print(f"{name:<14} not in both revisions")
            continue
        seconds = np.array([[of["seconds"][name] for of in both] for both in rounds])
        before, after = np.median(seconds, axis=0)
        ratio = seconds[:, 1] / seconds[:, 0]
        errors = [rounds[-1][side]["error"][name] for side in (0, 1)]
        spread = f"{ratio.min():.2f}-{ratio.max():.2f}"
        of_seconds = f"{before:9.4f} {after:9.4f} {np.median(ratio):6.2f} {spread:>12}"
        print(f"{name:<14} {of_seconds} {errors[0]:9.2g} {errors[1]:9.2g}")


if __name__ == "__main__":
    main()
