"""og_pointcloud: open-vocabulary labels for point clouds and Gaussian splats."""

from __future__ import annotations
