"""Errors the library raises on purpose. Each message holds the value seen, the value expected and the cure."""

from __future__ import annotations

__all__ = ["BundleError", "FeatureSpaceError", "MissingExtraError", "OgPointcloudError", "SceneError"]


class OgPointcloudError(ValueError):
    """Base of all errors raised by og_pointcloud for bad input; the command line prints it as one line.

    The message is printable whatever a file put into it: control characters and half characters become escapes.
    """

    def __init__(self, message: str) -> None:
        super().__init__("".join(sign if sign.isprintable() else repr(sign)[1:-1] for sign in message))


class SceneError(OgPointcloudError):
    """A capture folder, cloud, pose, mask or feature file cannot be used as it is."""


class BundleError(OgPointcloudError):
    """A ``.ogpc`` file is damaged, foreign, newer than this library, or hostile."""


class FeatureSpaceError(OgPointcloudError):
    """Vectors of two feature spaces, or of two widths, were about to be compared."""


class MissingExtraError(ImportError):
    """An optional dependency is absent; the message names the extra that brings it."""

    def __init__(self, module: str, extra: str) -> None:
        super().__init__(f"this needs {module}, which is not installed: pip install 'og-pointcloud[{extra}]'")
