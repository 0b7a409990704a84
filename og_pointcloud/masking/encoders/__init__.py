"""Mask encoders: what a mask shows, as a vector of the space that a text encoder of the same name puts words into.

``open_encoder`` opens CLIP, SigLIP and OpenCLIP models, their ONNX exports, and the embedded demo encoder, which knows
the procedural room's things alone.
"""

from og_pointcloud.masking.encoders.mask_encoder import CropEncoder, PatchEncoder
from og_pointcloud.masking.encoders.opening import DEMO_FOLDER, DEMO_SPACE, open_encoder

__all__ = ["DEMO_FOLDER", "DEMO_SPACE", "CropEncoder", "PatchEncoder", "open_encoder"]
