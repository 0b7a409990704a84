"""Mask models in ONNX, run by onnxruntime: SAM as an encoder and a decoder, and instance-segmentation detectors.

SAM. Encoder: one input (1, 3, S, S) float32, RGB, normalised as SAM wants it, longer side S, padded with 0 to the right
and below; one output, the embedding. Decoder: what segment-anything's export script writes, with the inputs
``image_embeddings``, ``point_coords`` (1, 2, 2), ``point_labels`` (1, 2), ``mask_input``, ``has_mask_input``,
``orig_im_size``, and the outputs ``iou_predictions`` and ``low_res_masks``; it answers one prompt a run.

Detectors, RGB in [0, 1], (1, 3, h, w), the image scaled to fit and padded with grey on both sides:
- YOLO's segmentation layout: (1, 4 + classes + c, n) with boxes x, y, w, h (middle and size, pixels of the input),
  class scores and mask coefficients, and prototypes (1, c, h / 4, w / 4);
- outputs called ``boxes`` (n, 4), ``scores`` (n,) and ``masks`` (n, h, w) or (n, 1, h, w), probabilities at the
  input's size, as torchvision's Mask R-CNN exports them (there the input has no batch axis).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import OgPointcloudError, SceneError
from og_pointcloud.formats.images import require_cv2
from og_pointcloud.masking.automatic import AutomaticMasks, best_boxes
from og_pointcloud.masking.contracts import MaskProposer, Proposals
from og_pointcloud.models import open_session

__all__ = ["OnnxDetector", "OnnxSamPredictor", "open_onnx"]

Floats = NDArray[np.float32]

SAM_MEAN = np.array([0.485, 0.456, 0.406], np.float32)
SAM_STD = np.array([0.229, 0.224, 0.225], np.float32)
SAM_SIDE = 1024
LOW_RES = 256
"""SAM's mask prompt, which is empty here."""
DETECTOR_SIDE = 640
"""Where the graph leaves its size open."""
GREY = 114 / 255
DECODER_INPUTS = {"image_embeddings", "point_coords", "point_labels", "mask_input", "has_mask_input", "orig_im_size"}
DECODER_OUTPUTS = {"iou_predictions", "low_res_masks"}


def open_onnx(files: Sequence[Path], *, seconds_per_image: float | None = None) -> MaskProposer:
    """One file: a detector. Two: SAM's encoder, then its decoder. SceneError says what a file is not."""
    if len(files) == 2:
        predictor = OnnxSamPredictor(*(_session(file) for file in files))
        return AutomaticMasks(predictor, f"onnx:{files[0].name}", batch=1, seconds_per_image=seconds_per_image)
    if len(files) == 1:
        return OnnxDetector(_session(files[0]), f"onnx:{files[0].name}")
    raise SceneError(f"{len(files)} ONNX files are named; expected a detector, or SAM's encoder and decoder")


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


@dataclass(frozen=True)
class OnnxDetector:
    """A proposer around an instance-segmentation detector.

    least_score: below, a detection is dropped. same_box: box IoU from which two detections are one. threshold: of mask
    probabilities.
    """

    session: Any
    name: str
    least_score: float = 0.25
    same_box: float = 0.7
    threshold: float = 0.5

    def propose(self, image: NDArray[np.uint8]) -> Proposals:
        """image: (H, W, 3) uint8 RGB. SceneError where the outputs are of neither layout."""
        source = self.session.get_inputs()[0]
        lengths = [length if isinstance(length, int) and length > 0 else DETECTOR_SIDE for length in source.shape[-2:]]
        frame = _Frame.fit((image.shape[0], image.shape[1]), (lengths[0], lengths[1]))
        pixels = frame.filled(image)
        outputs = _run(self.session, {source.name: pixels if len(source.shape) == 4 else pixels[0]})
        by_name = dict(zip((value.name for value in self.session.get_outputs()), outputs, strict=True))
        if {"boxes", "scores", "masks"} <= set(by_name):
            boxes, scores, probability = self._plain(by_name)
        elif len(outputs) == 2 and outputs[0].ndim == 3 and outputs[1].ndim == 4:
            boxes, scores, probability = self._from_prototypes(outputs[0], outputs[1], frame)
        else:
            shapes = {name: value.shape for name, value in by_name.items()}
            raise SceneError(
                f"{self.name} gives {shapes}; expected boxes, scores and masks, or YOLO's (1, 4 + classes + c, n) with "
                "prototypes (1, c, h, w)"
            )
        masks = np.zeros((len(boxes), *image.shape[:2]), np.bool_)
        for index, values in enumerate(probability):
            masks[index] = frame.back(values) > self.threshold
        seen = np.asarray(masks.any(axis=(1, 2)))
        return Proposals(masks[seen], np.clip(scores[seen], 0, 1).astype(np.float32))

    def _plain(self, outputs: dict[str, NDArray[Any]]) -> tuple[Floats, Floats, list[Floats]]:
        boxes, scores, masks = (np.asarray(outputs[name], np.float32) for name in ("boxes", "scores", "masks"))
        boxes, scores = boxes.reshape(-1, 4), scores.reshape(-1)
        masks = masks.reshape(-1, *masks.shape[-2:])
        if not len(boxes) == len(scores) == len(masks):
            raise SceneError(
                f"{self.name} gives {len(boxes)} boxes, {len(scores)} scores and {len(masks)} masks; expected as many"
            )
        kept = np.flatnonzero(scores >= self.least_score)
        kept = kept[best_boxes(boxes[kept], scores[kept], self.same_box)]
        return boxes[kept], scores[kept], list(masks[kept])

    def _from_prototypes(
        self, detections: Floats, prototypes: Floats, frame: _Frame
    ) -> tuple[Floats, Floats, list[Floats]]:
        rows, prototypes = detections[0].T, prototypes[0]
        count = len(prototypes)
        if rows.shape[1] < 4 + 1 + count:
            raise SceneError(
                f"{self.name} gives {rows.shape[1]} numbers a detection and {count} prototypes; expected 4 of a box, a "
                "score or more, and as many coefficients as prototypes"
            )
        scores = rows[:, 4 : rows.shape[1] - count].max(axis=1)
        rows, scores = rows[scores >= self.least_score], scores[scores >= self.least_score]
        boxes = np.concatenate([rows[:, :2] - rows[:, 2:4] / 2, rows[:, :2] + rows[:, 2:4] / 2], axis=1)
        kept = best_boxes(boxes, scores, self.same_box)
        boxes, scores, coefficients = boxes[kept], scores[kept], rows[kept, -count:]
        return (
            boxes,
            scores,
            [self._one(box, row, prototypes, frame) for box, row in zip(boxes, coefficients, strict=True)],
        )

    @staticmethod
    def _one(box: Floats, coefficients: Floats, prototypes: Floats, frame: _Frame) -> Floats:
        """(h, w) probability at the input's size, 0 outside the box."""
        logits = np.tensordot(coefficients, prototypes, 1).astype(np.float32)
        logits = require_cv2().resize(logits, frame.size[::-1], interpolation=require_cv2().INTER_LINEAR)
        left, top, right, bottom = np.clip(np.rint(box), 0, 1e5).astype(int)
        inside = np.zeros(frame.size, np.bool_)
        inside[top:bottom, left:right] = True
        return np.where(inside, 1 / (1 + np.exp(-np.clip(logits, -30, 30))), 0).astype(np.float32)


@dataclass(frozen=True)
class _Frame:
    """Where an image (H, W) lies in an input of ``size`` (h, w): scaled to ``inner``, from ``corner`` (top, left)."""

    image: tuple[int, int]
    size: tuple[int, int]
    inner: tuple[int, int]
    corner: tuple[int, int]

    @classmethod
    def fit(cls, image: tuple[int, int], size: tuple[int, int]) -> _Frame:
        scale = min(size[0] / image[0], size[1] / image[1])
        inner = max(1, round(image[0] * scale)), max(1, round(image[1] * scale))
        return cls(image, size, inner, ((size[0] - inner[0]) // 2, (size[1] - inner[1]) // 2))

    def filled(self, image: NDArray[np.uint8]) -> Floats:
        """(1, 3, h, w) float32 in [0, 1], grey around the image."""
        pixels = np.full((1, 3, *self.size), GREY, np.float32)
        top, left = self.corner
        pixels[0, :, top : top + self.inner[0], left : left + self.inner[1]] = _scaled(image, self.inner).transpose(
            2, 0, 1
        )
        return pixels

    def back(self, values: Floats) -> Floats:
        """(h, w) of the input or of a part of its resolution -> (H, W) of the image."""
        cv2 = require_cv2()
        if values.shape != self.size:
            values = cv2.resize(values, self.size[::-1], interpolation=cv2.INTER_LINEAR)
        top, left = self.corner
        part = np.ascontiguousarray(values[top : top + self.inner[0], left : left + self.inner[1]])
        return cv2.resize(part, self.image[::-1], interpolation=cv2.INTER_LINEAR)


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
