"""A very large cloud, fitted in tiles on a local Dask cluster: seconds by stage and memory by worker, compared with the
same fit without a cluster.

    PYTHONPATH=tests python examples/benchmark_street.py --points 20000000 --views 200 --tile-points 1000000

The street is generated (tests/street.py), so its truth is known: the last line scores the result. `--check` repeats the
fit without the cluster and compares all results bit for bit.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import fields
from pathlib import Path

import numpy as np

from og_pointcloud.cloud import LabelledCloud
from og_pointcloud.fitting.fit import fit
from og_pointcloud.fitting.memory import peak_memory
from og_pointcloud.settings import FitSettings

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))


def main() -> None:
    """Make, fit, compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, default=2_000_000)
    parser.add_argument("--views", type=int, default=60)
    parser.add_argument("--length", type=float, default=200.0, help="meters")
    parser.add_argument("--tile-points", type=int, default=500_000)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--memory", default="4GB", help="limit of each worker")
    parser.add_argument("--check", action="store_true", help="also fit without a cluster")
    arguments = parser.parse_args()
    from distributed import Client, LocalCluster
    from street import make_street  # pyright: ignore[reportMissingImports]

    made = make_street(arguments.points, arguments.views, length_m=arguments.length)
    settings = FitSettings(mode="grouping", tile_points=arguments.tile_points)
    limits = {"n_workers": arguments.workers, "threads_per_worker": 1, "memory_limit": arguments.memory}
    with LocalCluster(**limits, dashboard_address=None) as cluster, Client(cluster) as client:  # pyright: ignore[reportArgumentType]
        start, own = time.perf_counter(), time.process_time()
        cloud = fit(made.scene, settings, executor=client.get_executor(pure=False), progress=False)
        report("cluster", cloud, time.perf_counter() - start)
        peaks: dict[str, float] = client.run(peak_memory)  # pyright: ignore[reportAssignmentType]
        cpu: dict[str, float] = client.run(time.process_time)  # pyright: ignore[reportAssignmentType]
        print(f"CPU seconds: workers {sum(cpu.values()):.0f}, here {time.process_time() - own:.0f}")
        print("peak memory: workers", *(f"{peak / 1e9:.2f}" for peak in peaks.values()), end="")
        print(f", here {peak_memory() / 1e9:.2f} GB (with the scene)")
    print(f"instances whose points are mostly of one object: {purity(cloud, made.owner):.1%}")
    if arguments.check:
        start = time.perf_counter()
        plain = fit(made.scene, settings, progress=False)
        report("here alone", plain, time.perf_counter() - start)
        print("the same, bit for bit" if same(cloud, plain) else "NOT THE SAME")


def report(name: str, cloud: LabelledCloud, seconds: float) -> None:
    """One line."""
    stages = ", ".join(f"{stage['name']} {stage['seconds']:.0f}" for stage in cloud.provenance["stages"])
    tiles = len(cloud.provenance["notes"]["tiles"])
    print(f"{name}: {len(cloud):,} points, {tiles} tiles, {len(cloud.instances)} instances, {seconds:.0f} s ({stages})")


def purity(cloud: LabelledCloud, owner: np.ndarray) -> float:
    """Share of the points in instances that belong to their instance's most frequent object."""
    labelled = cloud.instance_ids >= 0
    table = np.zeros((len(cloud.instances), int(owner.max()) + 2), np.int64)
    np.add.at(table, (cloud.instance_ids[labelled], owner[labelled]), 1)  # ground, -1, is the last column
    return float(table.max(axis=1).sum() / max(1, labelled.sum()))


def same(first: LabelledCloud, second: LabelledCloud) -> bool:
    """Whether two clouds agree on every point and instance."""
    pairs = [(first.instance_ids, second.instance_ids), (first.certainty, second.certainty)]
    pairs += [
        (getattr(first.instances, column.name), getattr(second.instances, column.name))
        for column in fields(first.instances)
    ]
    # What is not known is NaN in both: tiles have no reliability.
    return all(np.array_equal(np.asarray(one, float), np.asarray(other, float), equal_nan=True) for one, other in pairs)


if __name__ == "__main__":
    main()
