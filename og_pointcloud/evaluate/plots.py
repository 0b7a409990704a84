"""Risk against coverage as a picture: a line each method, a ring where it stops answering."""

from __future__ import annotations

import io
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from og_pointcloud.errors import MissingExtraError
from og_pointcloud.evaluate.intervals import RiskCoverage
from og_pointcloud.formats.atomic import replacing

__all__ = ["plot_risk_coverage", "png_bytes", "require_matplotlib"]


def require_matplotlib() -> Any:
    """The class matplotlib.figure.Figure; MissingExtraError where matplotlib is not installed."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtraError("matplotlib", "report") from error
    return Figure


def png_bytes(figure: Any) -> bytes:
    """A matplotlib figure as a PNG."""
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=110)
    return data.getvalue()


def plot_risk_coverage(
    curves: Mapping[str, RiskCoverage], answered: Mapping[str, float], path: str | os.PathLike[str], title: str = ""
) -> Path:
    """Write a PNG, whole or not at all. curves: by method. answered: share of the points that each method answers of
    itself; beyond it lie the unknown ones, which count as wrong."""
    figure = require_matplotlib()(figsize=(7, 4.2), layout="constrained")
    axes = figure.subplots()
    for name, curve in curves.items():
        # From the first point on: with nothing answered there is no risk to speak of.
        coverage, risk = np.append(0, curve.coverage), np.append(curve.risk[:1], curve.risk)
        (line,) = axes.plot(100 * coverage, 100 * risk, label=f"{name} (area {curve.area:.4f})")
        stop = 100 * answered[name], 100 * float(np.interp(answered[name], coverage, risk))
        axes.plot(*stop, "o", ms=9, mfc="none", mew=1.8, color=line.get_color())
    axes.plot([], [], "o", ms=9, mfc="none", mew=1.8, color="0.3", label="answers no more: unknown counts as wrong")
    axes.set(xlabel="% of the points answered, surest first", ylabel="% of these that are wrong", title=title)
    axes.set(xlim=(0, 101), ylim=(0, None))
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, frameon=False)
    png = png_bytes(figure)
    with replacing(Path(path)) as file:
        file.write(png)
    return Path(path)
