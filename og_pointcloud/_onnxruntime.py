"""The one place that imports onnxruntime, so that it is always imported the same quiet way."""

from __future__ import annotations

import os

# Read on import, when it would otherwise write a device id and a usage database into the user's cache folder.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

import onnxruntime

__all__ = ["open_session"]

ERRORS_ONLY = 3


def open_session(model: bytes) -> onnxruntime.InferenceSession:
    """A CPU session that leaves the cores idle between runs. model: a serialised ONNX graph."""
    options = onnxruntime.SessionOptions()
    options.log_severity_level = ERRORS_ONLY
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
