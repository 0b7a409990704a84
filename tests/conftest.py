"""What all tests share."""

from __future__ import annotations

import os
from pathlib import Path

if "PYTEST_XDIST_WORKER" in os.environ:
    # A process per core: threads of torch and OpenBLAS spin while they wait for a core. Numba's sleep (kernels.py).
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(variable, "1")

import numpy as np
import pytest
from labelled_clouds import room
from scenes import TinyCapture, write_tiny_capture

import og_pointcloud as og


@pytest.fixture(scope="session")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`labelled_clouds.room` as a file, which no test changes."""
    return og.write_bundle(room(), tmp_path_factory.mktemp("scène") / "room.ogpc")


@pytest.fixture(scope="session")
def scene(bundle: Path) -> og.LabelledScene:
    """The same, opened."""
    return og.load(bundle)


@pytest.fixture
def tiny_capture(tmp_path: Path) -> TinyCapture:
    """A plain-format capture of about 1,500 points and 6 views in ``tmp_path / "capture"``."""
    return write_tiny_capture(tmp_path / "capture")


@pytest.fixture
def random() -> np.random.Generator:
    """The same numbers in every test."""
    return np.random.default_rng(0)
