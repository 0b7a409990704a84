"""Where Hugging Face's own tools keep the models that they have fetched. Nothing is fetched here."""

from __future__ import annotations

import os
import re
from pathlib import Path

__all__ = ["MODEL_NAME", "fetched_model", "hub_cache"]

MODEL_NAME = re.compile(r"[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*", re.ASCII)
REVISION = re.compile(r"[0-9a-f]{40}")


def hub_cache() -> Path:
    """The folder of fetched models, by the variables that Hugging Face's tools go by; it need not exist."""
    if hub := os.environ.get("HF_HUB_CACHE"):
        return Path(hub)
    home = os.environ.get("HF_HOME")
    return Path(home) / "hub" if home else Path.home() / ".cache" / "huggingface" / "hub"


def fetched_model(name: str) -> Path | None:
    """The folder of OWNER/MODEL as it was last fetched; None where it was not, or the name is none of that kind."""
    if not MODEL_NAME.fullmatch(name):
        return None
    model = hub_cache() / f"models--{name.replace('/', '--')}"
    main = model / "refs" / "main"
    revision = main.read_text(encoding="utf-8", errors="replace").strip()[:64] if main.is_file() else ""
    folder = model / "snapshots" / revision
    return folder if REVISION.fullmatch(revision) and folder.is_dir() else None
