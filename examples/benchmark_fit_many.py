"""Many made captures, one of them broken, fitted on two local Dask workers, one of which is killed midway: the outcome,
compared with the same captures fitted one after another.

    PYTHONPATH=tests python examples/benchmark_fit_many.py --captures 24
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import og_pointcloud as og

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))


def main() -> None:
    """Make, fit twice, compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--captures", type=int, default=24)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        captures = make(Path(folder) / "scans", arguments.captures)
        first, second = Path(folder) / "one_by_one", Path(folder) / "cluster"
        start = time.perf_counter()
        with ThreadPoolExecutor(1) as executor:
            og.fit_many(captures, first, executor, progress=False)
        print(f"one after another: {time.perf_counter() - start:.1f} s")
        start = time.perf_counter()
        fits = on_cluster(captures, second)
        print(f"two Dask workers, one of them killed: {time.perf_counter() - start:.1f} s")
        for fit in fits:
            if fit.state != "fitted":
                print(f"  {fit.name}: {fit.state}: {fit.cause[:160]}")
        same = [path.read_bytes() == (second / path.name).read_bytes() for path in sorted(first.iterdir())]
        print(
            f"{sum(same)} of {len(same)} files are the same, byte for byte; {len(captures) - len(same)} were not made"
        )


def make(folder: Path, count: int) -> list[Path]:
    """Captures of 3 to 8 views, the third without readable cameras."""
    from scenes import write_tiny_capture  # pyright: ignore[reportMissingImports]

    captures = [write_tiny_capture(folder / f"room{k:02d}", 3 + k % 6).folder for k in range(count)]
    (captures[2] / "transforms.json").write_text("{")
    return captures


def on_cluster(captures: list[Path], out: Path) -> tuple[og.CaptureFit, ...]:
    """Fit on two workers and kill one of them when work has begun."""
    from distributed import Client, LocalCluster

    with (
        LocalCluster(n_workers=2, threads_per_worker=1, memory_limit="4GB", dashboard_address=None) as cluster,  # pyright: ignore[reportArgumentType]
        Client(cluster) as client,
    ):
        threading.Thread(target=kill_one, args=(client, out), daemon=True).start()
        return og.fit_many(captures, out, client.get_executor(pure=False), progress=False)


def kill_one(client: Any, out: Path) -> None:
    """Kill a worker as soon as four files are written and a fit is under way."""
    pids = list(client.run(os.getpid).values())
    while len(list(out.glob("*.ogpc"))) < 4 or not list(out.glob("*.work")):
        time.sleep(0.005)
    os.kill(pids[0], signal.SIGKILL)
    print(f"  killed process {pids[0]} with {len(list(out.glob('*.ogpc')))} files made")


if __name__ == "__main__":
    main()
