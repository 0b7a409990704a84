"""What the command line says -> a mask proposer."""

from __future__ import annotations

from pathlib import Path

from og_pointcloud.errors import SceneError
from og_pointcloud.masking.contracts import MaskProposer

__all__ = ["open_proposer"]


def open_proposer(said: str, *, seconds_per_image: float | None = None, download: bool = False) -> MaskProposer:
    """``opencv``; ``sam:FOLDER`` or ``sam:OWNER/MODEL``; ``onnx:FILE`` (a detector) or ``onnx:ENCODER,DECODER`` (SAM);
    ``python:MODULE:NAME``, a function or proposer of the user's own (`existing.own_proposer`).

    seconds_per_image: where SAM stops adding prompts; None: never. download: let transformers fetch the model.
    Nothing is downloaded otherwise. SceneError names what is known. A folder of masks is no proposer of this kind: it
    goes by the image's name (`existing.ExistingMasks`).
    """
    kind, _, name = said.partition(":")
    if said == "opencv":
        from og_pointcloud.masking.opencv import OpenCVProposer

        return OpenCVProposer()
    if kind == "sam" and name:
        from og_pointcloud.masking.sam import open_sam

        return open_sam(name, seconds_per_image=seconds_per_image, download=download)
    if kind == "onnx" and name:
        from og_pointcloud.masking.onnx import open_onnx

        return open_onnx([Path(part) for part in name.split(",")], seconds_per_image=seconds_per_image)
    if kind == "python" and name:
        from og_pointcloud.masking.existing import own_proposer

        return own_proposer(name)
    raise SceneError(
        f"proposer is '{said}'; expected opencv, sam:FOLDER, sam:OWNER/MODEL, onnx:DETECTOR.onnx, "
        "onnx:ENCODER.onnx,DECODER.onnx, python:MODULE:NAME, or a folder of id PNGs or COCO JSON files"
    )
