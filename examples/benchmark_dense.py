"""What describing an image's masks costs by crops and by dense pooling: a CLIP of B/16's size with random weights.

    python examples/benchmark_dense.py [--masks 4 16 64]

Processor seconds of all cores together. Random weights say nothing of what the vectors mean; that both are the model's
own parts is tested (tests/test_dense_features.py, test_encoders.py).
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
import transformers
from numpy.typing import NDArray

from og_pointcloud.masking.clip import TransformersModel
from og_pointcloud.masking.contracts import MaskEncoder
from og_pointcloud.masking.dense import DenseEncoder
from og_pointcloud.masking.encode import CropEncoder

SIZE = (480, 640)
SPACE = "random/clip-vit-base-patch16"


def boxes(count: int) -> NDArray[np.bool_]:
    """(count, H, W): masks of a twelfth of the image's area."""
    rng, masks = np.random.default_rng(0), np.zeros((count, *SIZE), np.bool_)
    for mask in masks:
        top, left = rng.integers(0, SIZE[0] - 140), rng.integers(0, SIZE[1] - 180)
        mask[top : top + 140, left : left + 180] = True
    return masks


def seconds(encoder: MaskEncoder, masks: NDArray[np.bool_]) -> float:
    """Of the processor, for one image."""
    image = np.random.default_rng(1).integers(0, 256, (*SIZE, 3), np.uint8)
    start = time.process_time()
    encoder.embed(image, masks)
    return time.process_time() - start


def main(arguments: list[str] | None = None) -> None:
    """The table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--masks", type=int, nargs="+", default=[4, 16, 64])
    options = parser.parse_args(arguments)
    torch.manual_seed(0)
    with tempfile.TemporaryDirectory() as folder:
        vision = {"patch_size": 16}
        transformers.CLIPModel(transformers.CLIPConfig(vision_config=vision)).save_pretrained(Path(folder))
        model = TransformersModel(folder, SPACE)
    crops, dense = CropEncoder(model, model.crops), DenseEncoder(model)
    seconds(dense, boxes(1))  # which loads what is loaded once
    print(f"{'masks':>6} {'crops s':>9} {'dense s':>9} {'ratio':>7}")
    for count in options.masks:
        masks = boxes(count)
        slow, fast = seconds(crops, masks), seconds(dense, masks)
        print(f"{count:6} {slow:9.2f} {fast:9.2f} {slow / fast:7.1f}", flush=True)


if __name__ == "__main__":
    main()
