"""The cost of describing an image's masks by crops and by dense pooling, in torch and exported: a CLIP of B/16's size
with random weights.

    python examples/benchmark_dense.py [--masks 4 16 64]

Processor seconds of all cores together, and the largest difference of an entry of the unit vectors between torch and
the exported graph. With random weights the vectors mean nothing; that they are computed from the model's own parts is
tested (tests/test_dense_features.py, test_encoders.py).
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
from og_pointcloud_export.encoders import export_image_encoder

from og_pointcloud.masking.clip import TransformersModel
from og_pointcloud.masking.contracts import FEATURES, MaskEncoder
from og_pointcloud.masking.dense import DenseEncoder
from og_pointcloud.masking.encode import CropEncoder, open_encoder

SIZE = (480, 640)
SPACE = "random/clip-vit-base-patch16"


def boxes(count: int) -> NDArray[np.bool_]:
    """(count, H, W): masks of a twelfth of the image's area."""
    rng, masks = np.random.default_rng(0), np.zeros((count, *SIZE), np.bool_)
    for mask in masks:
        top, left = rng.integers(0, SIZE[0] - 140), rng.integers(0, SIZE[1] - 180)
        mask[top : top + 140, left : left + 180] = True
    return masks


def run(encoder: MaskEncoder, masks: NDArray[np.bool_]) -> tuple[float, NDArray[np.float32]]:
    """Processor seconds for one image, and the vectors."""
    image = np.random.default_rng(1).integers(0, 256, (*SIZE, 3), np.uint8)
    start = time.process_time()
    vectors = encoder.embed(image, masks)
    return time.process_time() - start, vectors


def main(arguments: list[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--masks", type=int, nargs="+", default=[4, 16, 64])
    options = parser.parse_args(arguments)
    torch.manual_seed(0)
    with tempfile.TemporaryDirectory() as folder:
        vision = {"patch_size": 16}
        transformers.CLIPModel(transformers.CLIPConfig(vision_config=vision)).save_pretrained(Path(folder))
        model = TransformersModel(folder, SPACE)
        exported, _ = export_image_encoder(folder, Path(folder) / "onnx", feature_space=SPACE)
        light_ones = [open_encoder(exported, features) for features in FEATURES]
    print(f"{'masks':>6} {'features':<8} {'torch s':>9} {'exported s':>11} {'difference':>11}")
    for name, in_torch, light in zip(FEATURES, (CropEncoder(model), DenseEncoder(model)), light_ones, strict=True):
        for encoder in (in_torch, light):
            run(encoder, boxes(1))  # one-time loading
        for count in options.masks:
            masks = boxes(count)
            (slow, expected), (fast, found) = run(in_torch, masks), run(light, masks)
            print(f"{count:6} {name:<8} {slow:9.2f} {fast:11.2f} {np.abs(found - expected).max():11.1e}", flush=True)


if __name__ == "__main__":
    main()
