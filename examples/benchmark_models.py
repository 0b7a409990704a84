"""What full-size models take on this machine, an image: SAM and CLIP of their published sizes, with random weights.

    python examples/benchmark_models.py [--only sam] [--prompts 128] [--crops 32]

Time and memory are those of the architecture: weights would change neither. Nothing is fetched. Each model is measured
in a process of its own. SAM's time for its whole grid of 1024 prompts is extrapolated from those that are run.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

SPACE = "benchmark/random-weights"
GRID = 1024
IMAGE = (730, 986)
"""Height and width of LeRF-OVS's images as the paper trains on them."""
MODELS = {"sam": "SAM ViT-B", "sam2": "SAM 2.1 hiera, base configuration", "clip": "CLIP ViT-B/16"}
SMALL = {"hidden_size": 32, "num_hidden_layers": 1, "num_attention_heads": 2}


def saved(kind: str, folder: Path, small: bool) -> None:
    """A model of the published size, or a tiny one, in transformers' format."""
    import transformers as t

    if kind == "sam":
        vision = (
            {**SMALL, "image_size": 64, "window_size": 2, "global_attn_indexes": [0], "mlp_dim": 32} if small else {}
        )
        prompt = {"image_size": 64, "image_embedding_size": 4} if small else {}
        config = t.SamConfig(vision_config=vision, prompt_encoder_config=prompt)
        t.SamModel(config).save_pretrained(folder)
    elif kind == "sam2":
        t.Sam2Model(t.Sam2Config()).save_pretrained(folder)
    else:
        text = {**SMALL, "intermediate_size": 32, "vocab_size": 64, "bos_token_id": 1, "eos_token_id": 2}
        vision = {**SMALL, "image_size": 32, "patch_size": 8, "intermediate_size": 32} if small else {"patch_size": 16}
        config = t.CLIPConfig(vision_config=vision, text_config=text, projection_dim=32 if small else 512)
        t.CLIPModel(config).save_pretrained(folder)


def measured(kind: str, prompts: int, crops: int, small: bool) -> dict[str, float | str]:
    """One row: seconds of loading and of an image's parts, peak memory."""
    from og_pointcloud.masking.encoders import open_encoder

    image = np.random.default_rng(0).integers(0, 256, (*IMAGE, 3)).astype(np.uint8)
    with tempfile.TemporaryDirectory() as temporary:
        saved(kind, Path(temporary), small)
        start = time.perf_counter()
        row: dict[str, float | str] = {"model": MODELS[kind]}
        if kind == "clip":
            encoder = open_encoder(temporary, SPACE)
            row["load_s"] = time.perf_counter() - start
            masks = np.zeros((crops, *IMAGE), bool)
            for index in range(crops):
                masks[index, 20 * index % 500 : 20 * index % 500 + 150, 50:250] = True
            start = time.perf_counter()
            encoder.embed(image, masks)
            row["s_per_16_masks"] = 16 * (time.perf_counter() - start) / crops
        else:
            from og_pointcloud.masking.sam import SamPredictor

            predictor = SamPredictor(temporary)
            row["load_s"] = time.perf_counter() - start
            start = time.perf_counter()
            predictor.set_image(image)
            row["encode_s"] = time.perf_counter() - start
            points = np.random.default_rng(1).uniform(0, min(IMAGE), (prompts, 2)).astype(np.float32)
            start = time.perf_counter()
            for first in range(0, prompts, 64):
                predictor.at_points(points[first : first + 64])
            row["s_per_64_prompts"] = 64 * (time.perf_counter() - start) / prompts
            row["whole_grid_s"] = row["encode_s"] + GRID / 64 * row["s_per_64_prompts"]
    row["peak_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    return row


def main() -> None:
    """A row a model; with --row that model alone, as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=MODELS, help="one model")
    parser.add_argument("--prompts", type=int, default=128, help="points that SAM is asked at (default: %(default)s)")
    parser.add_argument("--crops", type=int, default=32, help="masks that CLIP is shown (default: %(default)s)")
    parser.add_argument("--small", action="store_true", help="tiny models, to try the command itself")
    parser.add_argument("--row", choices=MODELS, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.row:
        import torch

        # Fresh random weights are so small that products fall below float32's normal numbers: ten times slower.
        torch.set_flush_denormal(True)
        print(json.dumps(measured(arguments.row, arguments.prompts, arguments.crops, arguments.small)))
        return
    for kind in [arguments.only] if arguments.only else MODELS:
        command = [sys.executable, __file__, "--row", kind, *sys.argv[1:]]
        row = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()[-1])
        print(row.pop("model") + ": " + ", ".join(f"{name} {value:.4g}" for name, value in row.items()), flush=True)


if __name__ == "__main__":
    main()
