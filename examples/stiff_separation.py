"""Eq. 2 from means that have met: plain Adam on the printed loss against the library's step, in float32.

    python examples/stiff_separation.py -o OUT

Three masks of one view, 200 Gaussians each, all features equal but for a start distance of 0 to 0.1 between the masks.
Writes stiff_separation.csv (a row per method and start distance), stiff_trajectories.csv and stiff_separation.png
(smallest distance between two means, after each step).
"""

from __future__ import annotations

import argparse
import csv
import time
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from og_pointcloud.fitting.learned.instance_features import learn_features
from og_pointcloud.fitting.mask_table import MaskTable
from og_pointcloud.settings import FeatureSettings

MASKS, GAUSSIANS, WIDTH = 3, 200, 6
STARTS = (0.0, 1e-12, 1e-9, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1)
SEPARATE = 0.5
"""Means this far apart count as separate; features lie in the unit ball."""
ADAM_STEPS = 3000
ADAM_RATE = 1e-3


@dataclass(frozen=True)
class Run:
    """One descent. distances: smallest distance between two means, before and after every step. updates: the largest
    change of a feature in each step. objective: the printed Eq. 2 of the last means."""

    method: str
    start: float
    distances: list[float]
    updates: list[float]
    objective: float
    seconds: float

    def row(self) -> dict[str, float | int | str | bool]:
        """What the table says of it; steps to separate is empty where that never happened."""
        apart = np.flatnonzero(np.array(self.distances) >= SEPARATE)
        return {
            "method": self.method,
            "start_distance": self.start,
            "steps_to_separate": int(apart[0]) if len(apart) else "",
            "steps": len(self.updates),
            "largest_update": float(np.max(self.updates, initial=0)),
            "any_nan": not np.isfinite([*self.distances, *self.updates, self.objective]).all(),
            "final_distance": self.distances[-1],
            "final_objective": self.objective,
            "seconds": round(self.seconds, 4),
        }


def table() -> MaskTable:
    """Masks that share no Gaussian, in one view."""
    weights = csr_array(np.kron(np.eye(MASKS), np.ones((1, GAUSSIANS))).astype(np.float32))
    nothing = csr_array(np.zeros((1, weights.shape[1]), np.float32))
    area = np.full(MASKS, GAUSSIANS, np.int32)
    return MaskTable(weights, nothing, nothing, np.zeros(MASKS, np.int32), area, np.zeros((MASKS, 1), np.float32))


def start_features(distance: float) -> NDArray[np.float32]:
    """Every Gaussian at 0.2, those of mask i moved along axis i so that two means are ``distance`` apart."""
    start = np.full((MASKS * GAUSSIANS, WIDTH), 0.2, np.float32)
    for mask in range(MASKS):
        start[mask * GAUSSIANS : (mask + 1) * GAUSSIANS, mask] += np.float32(distance / np.sqrt(2))
    return start


def mean_pairs(features: NDArray[np.float32]) -> NDArray[np.float64]:
    """Distances between the masks' means, one per pair."""
    means = features.astype(np.float64).reshape(MASKS, GAUSSIANS, -1).mean(axis=1)
    return np.linalg.norm(means[[0, 0, 1]] - means[[1, 2, 2]], axis=1)


def printed_objective(features: NDArray[np.float32]) -> float:
    """Eq. 2 without any bound."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return float(np.mean(1 / mean_pairs(features) ** 2))


def adam(distance: float) -> Run:
    """Adam on Eq. 2 as printed, gradients by automatic differentiation in float32; stops where it is not finite."""
    import torch

    features = torch.tensor(start_features(distance), requires_grad=True)
    optimiser = torch.optim.Adam([features], lr=ADAM_RATE)
    distances, updates = [float(mean_pairs(features.detach().numpy()).min())], []
    begin = time.perf_counter()
    for _ in range(ADAM_STEPS):
        means = features.reshape(MASKS, GAUSSIANS, -1).mean(dim=1)
        square = (means[[0, 0, 1]] - means[[1, 2, 2]]).square().sum(dim=1)
        optimiser.zero_grad()
        (1 / square).mean().backward()
        before = features.detach().clone()
        optimiser.step()
        updates.append(float((features.detach() - before).norm(dim=1).max()))
        distances.append(float(mean_pairs(features.detach().numpy()).min()))
        if not np.isfinite(distances[-1]) or distances[-1] >= SEPARATE:
            break
    seconds = time.perf_counter() - begin
    return Run("adam", distance, distances, updates, printed_objective(features.detach().numpy()), seconds)


def ours(distance: float) -> Run:
    """The library's step: Eq. 2 with a bound that shrinks, L-BFGS, no feature moved far; met means are parted first.

    Features lie in the unit ball, for Eq. 2 alone has its minimum at infinity.
    """
    settings = FeatureSettings(intra=False, normalise=False)
    scene, start = table(), start_features(distance)
    begin = time.perf_counter()
    learned = learn_features(scene, settings, start=start)
    seconds = time.perf_counter() - begin
    # The same descent again, stopped after 0, 1, 2 ... steps: step 0 is the start with its means parted.
    path = [start]
    for steps in range(learned.steps + 1):
        path.append(learn_features(scene, replace(settings, max_steps=steps), start=start).features)
    updates = [float(np.linalg.norm(after - before, axis=1).max()) for before, after in pairwise(path)]
    distances = [float(mean_pairs(features).min()) for features in path]
    return Run("ours", distance, distances, updates, printed_objective(learned.features), seconds)


def plot(runs: list[Run], path: Path) -> None:
    """Distance against step, a panel per method, a line per start."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(1, 2, figsize=(11, 4.2), sharey=True, layout="constrained")
    colours = plt.get_cmap("viridis")(np.linspace(0, 0.9, len(STARTS)))
    for panel, method, title in zip(
        panels, ("adam", "ours"), ("Adam on the printed Eq. 2", "this library"), strict=True
    ):
        for run, colour in zip((run for run in runs if run.method == method), colours, strict=True):
            distance = np.maximum(np.nan_to_num(run.distances, nan=0), 1e-13)
            ended = "" if np.isfinite(run.distances).all() else ", NaN"
            panel.loglog(
                np.arange(len(distance)) + 1, distance, color=colour, label=f"{run.start:g}{ended}", marker="."
            )
        panel.axhline(SEPARATE, color="grey", linewidth=0.8, linestyle="--")
        panel.set(title=title, xlabel="step + 1")
        panel.legend(title="start distance", fontsize=7, ncols=2)
    panels[0].set_ylabel("smallest distance between two means")
    figure.savefig(path, dpi=120)


def write_csv(path: Path, rows: list[dict[str, float | int | str | bool]]) -> None:
    """Rows of one shape as a table."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)


def main() -> None:
    """Run every start distance with both methods; write tables and picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder for the tables and the picture")
    output = parser.parse_args().output
    output.mkdir(parents=True, exist_ok=True)
    learn_features(table(), FeatureSettings(max_steps=1))  # compiled before anything is timed
    runs = [method(distance) for method in (adam, ours) for distance in STARTS]
    rows = [run.row() for run in runs]
    write_csv(output / "stiff_separation.csv", rows)
    trajectories = [
        {"method": run.method, "start_distance": run.start, "step": step, "distance": distance}
        for run in runs
        for step, distance in enumerate(run.distances)
    ]
    write_csv(output / "stiff_trajectories.csv", trajectories)
    plot(runs, output / "stiff_separation.png")
    print("method  start   steps to 0.5  largest update  NaN    final Eq. 2  seconds")
    for run in runs:
        row = run.row()
        print(
            f"{run.method:6}  {run.start:<6g}  {row['steps_to_separate']!s:>12}  {row['largest_update']:14.3g}  "
            f"{row['any_nan']!s:5}  {run.objective:11.4g}  {run.seconds:7.3f}"
        )


if __name__ == "__main__":
    main()
