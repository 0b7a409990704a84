"""SAM in ONNX, run by onnxruntime: an encoder and a decoder.

Encoder: one input (1, 3, S, S) float32, RGB, normalised as SAM wants it, longer side S, padded with 0 to the right and
below; one output, the embedding. Decoder: what segment-anything's export script writes, with the inputs
``image_embeddings``, ``point_coords`` (1, 2, 2), ``point_labels`` (1, 2), ``mask_input``, ``has_mask_input``,
``orig_im_size``, and the outputs ``iou_predictions`` and ``low_res_masks``; it answers one prompt a run.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import OgPointcloudError, SceneError
from og_pointcloud.formats.images import require_cv2
from og_pointcloud.masking.automatic import AutomaticMasks
from og_pointcloud.models import open_session

__all__ = ["OnnxSamPredictor", "open_onnx"]

Floats = NDArray[np.float32]

SAM_MEAN = np.array([0.485, 0.456, 0.406], np.float32)
SAM_STD = np.array([0.229, 0.224, 0.225], np.float32)
SAM_SIDE = 1024
LOW_RES = 256
"""SAM's mask prompt, which is empty here."""
DECODER_INPUTS = {"image_embeddings", "point_coords", "point_labels", "mask_input", "has_mask_input", "orig_im_size"}
DECODER_OUTPUTS = {"iou_predictions", "low_res_masks"}


def open_onnx(files: Sequence[Path], *, seconds_per_image: float | None = None) -> AutomaticMasks:
    """A proposer from SAM's encoder and its decoder, in this order. SceneError says what a file is not."""
    if len(files) != 2:
        raise SceneError(
            f"{len(files)} ONNX files are named; expected two, SAM's encoder and decoder: a detector's masks come "
            "in as a folder of COCO .json files or id PNGs"
        )
    predictor = OnnxSamPredictor(*(_session(file) for file in files))
    return AutomaticMasks(predictor, f"onnx:{files[0].name}", batch=1, seconds_per_image=seconds_per_image)


def _session(file: Path) -> Any:
    if not file.is_file():
        raise SceneError(f"{file} is no file; expected an ONNX model")
    try:
        return open_session(file.read_bytes())
    except Exception as error:  # onnxruntime's errors have no common class
        raise SceneError(f"{file} cannot be opened as an ONNX model: {str(error).splitlines()[0]:.200}") from None


class OnnxSamPredictor:
    """A `PointPredictor` on an encoder and a decoder."""

    def __init__(self, encoder: Any, decoder: Any) -> None:
        inputs = {value.name for value in decoder.get_inputs()}
        outputs = {value.name for value in decoder.get_outputs()}
        if DECODER_INPUTS - inputs or DECODER_OUTPUTS - outputs:
            raise SceneError(
                f"the decoder takes {sorted(inputs)} and gives {sorted(outputs)}; expected "
                f"{sorted(DECODER_INPUTS)} and {sorted(DECODER_OUTPUTS)}: export it with segment-anything's script"
            )
        shape = encoder.get_inputs()[0].shape
        if len(shape) != 4 or shape[1] != 3:
            raise SceneError(f"the encoder takes {shape}; expected (1, 3, {SAM_SIDE}, {SAM_SIDE})")
        self.encoder, self.decoder = encoder, decoder
        self.side = shape[3] if isinstance(shape[3], int) else SAM_SIDE
        self.size, self.scaled = (0, 0), (0, 0)
        self.embedding = np.zeros(0, np.float32)

    def set_image(self, image: NDArray[np.uint8]) -> None:
        """image: (H, W, 3) uint8 RGB."""
        self.size = image.shape[0], image.shape[1]
        scale = self.side / max(self.size)
        self.scaled = int(self.size[0] * scale + 0.5), int(self.size[1] * scale + 0.5)
        small = _scaled(image, self.scaled)
        pixels = np.zeros((1, 3, self.side, self.side), np.float32)
        pixels[0, :, : self.scaled[0], : self.scaled[1]] = ((small - SAM_MEAN) / SAM_STD).transpose(2, 0, 1)
        self.embedding = _run(self.encoder, {self.encoder.get_inputs()[0].name: pixels})[0]

    def at_points(self, points: Floats) -> tuple[Floats, Floats]:
        """points: (k, 2). Logits (k, m, h, w) that cover the image, predicted IoU (k, m)."""
        answers = [self._at(point) for point in points]
        return np.stack([logits for logits, _ in answers]), np.stack([iou for _, iou in answers])

    def _at(self, point: Floats) -> tuple[Floats, Floats]:
        scale = np.array([self.scaled[1] / self.size[1], self.scaled[0] / self.size[0]], np.float32)
        feed = {
            "image_embeddings": self.embedding,
            # The second point, labelled -1, stands for the box that is not given.
            "point_coords": np.array([[point * scale, (0, 0)]], np.float32),
            "point_labels": np.array([[1, -1]], np.float32),
            "mask_input": np.zeros((1, 1, LOW_RES, LOW_RES), np.float32),
            "has_mask_input": np.zeros(1, np.float32),
            "orig_im_size": np.array(self.size, np.float32),
        }
        iou, logits = _run(self.decoder, feed, ["iou_predictions", "low_res_masks"])
        rows = max(1, round(logits.shape[2] * self.scaled[0] / self.side))
        columns = max(1, round(logits.shape[3] * self.scaled[1] / self.side))
        iou, logits = iou[0], logits[0, :, :rows, :columns]
        # The first of four is the answer to several prompts, worthless for one point.
        return (logits[1:], iou[1:]) if len(iou) == 4 else (logits, iou)


def _scaled(image: NDArray[np.uint8], size: tuple[int, int]) -> Floats:
    """(h, w, 3) float32 in [0, 1]."""
    cv2 = require_cv2()
    smaller = size[0] < image.shape[0]
    pixels = cv2.resize(image, size[::-1], interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR)
    return pixels.astype(np.float32) / 255


def _run(session: Any, feed: dict[str, NDArray[Any]], outputs: list[str] | None = None) -> list[NDArray[Any]]:
    try:
        return session.run(outputs, feed)
    except Exception as error:  # onnxruntime's errors have no common class
        raise OgPointcloudError(f"the ONNX model does not run: {str(error).splitlines()[0]:.200}") from None
