"""What all tests share."""

from __future__ import annotations

from pathlib import Path

import pytest
from scenes import TinyCapture, write_tiny_capture


@pytest.fixture
def tiny_capture(tmp_path: Path) -> TinyCapture:
    """A plain-format capture of about 1,500 points and 6 views in ``tmp_path / "capture"``."""
    return write_tiny_capture(tmp_path / "capture")
