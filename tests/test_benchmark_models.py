"""The benchmark of full-size models, on tiny ones: rows hold what they say."""

import sys
from pathlib import Path

import pytest

pytest.importorskip("torch")
pytest.importorskip("transformers")
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))

from benchmark_models import GRID, MODELS, measured


@pytest.mark.filterwarnings("ignore")
def test_rows_of_sam_and_clip():
    sam = measured("sam", prompts=4, crops=2, small=True)
    assert sam["model"] == MODELS["sam"]
    assert sam["whole_grid_s"] == pytest.approx(sam["encode_s"] + GRID / 64 * sam["s_per_64_prompts"])
    clip = measured("clip", prompts=4, crops=2, small=True)
    assert clip["s_per_16_masks"] > 0
    assert {"load_s", "peak_mb"} <= set(sam) & set(clip)
