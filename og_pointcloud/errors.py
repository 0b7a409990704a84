"""Errors that the library raises on purpose. Each message gives the value seen, the value expected and the cure."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


def printable(text: str, most: int | None = None) -> str:
    """Untrusted text made safe to show: characters that would move the cursor or reverse the text, and half characters,
    become escapes; text beyond ``most`` characters is cut.

    >>> from og_pointcloud.errors import printable
    >>> printable("mug" + chr(27) + "[2J"), printable("chair" * 9, 12)
    ('mug\\\\x1b[2J', 'chairchai...')
    """
    text = text if most is None else text[: most + 1]
    shown = text if text.isprintable() else "".join(s if s.isprintable() else repr(s)[1:-1] for s in text)
    return shown if most is None or len(shown) <= most else f"{shown[: most - 3]}..."


def coordinate(value: float) -> str:
    """A coordinate as text: at least to a tenth of a unit, for which four digits of a map's 4000123.4 do not suffice.

    >>> from og_pointcloud.errors import coordinate
    >>> coordinate(0.52314), coordinate(4000123.4321)
    ('0.5231', '4000123.4')
    """
    return f"{value:.1f}" if 1e3 <= abs(value) < 1e15 else f"{value:.4g}"


def counted(count: int, thing: str) -> str:
    """A count with its noun, as text.

    >>> from og_pointcloud.errors import counted
    >>> counted(1, "scene"), counted(1200, "scene")
    ('1 scene', '1,200 scenes')
    """
    return f"{count:,} {thing}{'' if count == 1 else 's'}"


def span(points: NDArray[np.floating]) -> str:
    """The extent of points (n, 3) as text, from..to along x, y and z."""
    bounds = zip(points.min(axis=0), points.max(axis=0), strict=True)
    return " x ".join(f"{coordinate(low)}..{coordinate(high)}" for low, high in bounds)


def first_line(error: BaseException) -> str:
    """First line of another library's error, at most 200 characters; its type's name if the text is empty."""
    return (str(error).strip() or type(error).__name__).splitlines()[0][:200]


def did_you_mean(word: str, known: Iterable[str], then: str = "") -> str:
    """Part of a message that names known words similar to this one, followed by ``then``; "" if there are none.

    >>> from og_pointcloud.errors import did_you_mean
    >>> did_you_mean("table", ["apple", "dining table"]), did_you_mean("aple", ["apple", "dining table"])
    ("; did you mean 'dining table'?", "; did you mean 'apple'?")
    """
    import difflib  # only when something went wrong

    # Wrong case is a common slip, and difflib would count each letter of it.
    word, by_lower = word.lower(), {name.lower(): name for name in known}
    # Shared words come first: "table" means "dining table" rather than "apple".
    parts = [name for name in by_lower if word in name.split() or name in word.split()]
    close = [by_lower[match] for match in (parts or difflib.get_close_matches(word, by_lower))[:3]]
    return f"; did you mean {' or '.join(repr(name) for name in close)}?{then}" if close else ""


class OgPointcloudError(ValueError):
    """Base of all errors raised by og_pointcloud for bad input; the command line prints it as one line.

    The message is printable whatever a file contains: control characters and half characters become escapes.

    >>> import og_pointcloud as og
    >>> issubclass(og.SceneError, og.OgPointcloudError), issubclass(og.OgPointcloudError, ValueError)
    (True, True)
    """

    def __init__(self, message: str) -> None:
        super().__init__(printable(message))


class SceneError(OgPointcloudError):
    """A capture folder, cloud, pose, mask or feature file cannot be used as it is.

    >>> import og_pointcloud as og
    >>> og.axis_aligned_box([])
    Traceback (most recent call last):
        ...
    og_pointcloud.errors.SceneError: points are float64 of shape (0,); expected numbers (n, 3), at least one point, ...
    """


class BundleError(OgPointcloudError):
    """A ``.ogpc`` file is damaged, foreign, newer than this library, or hostile.

    >>> import og_pointcloud as og
    >>> og.load("no.ogpc")
    Traceback (most recent call last):
        ...
    og_pointcloud.errors.BundleError: no.ogpc is not a file; expected a .ogpc file: ...
    """


class FeatureSpaceError(OgPointcloudError):
    """Vectors of two feature spaces, or of two widths, were about to be compared.

    >>> og.segment(cloud, {"mug": np.ones(3)})  # of `LabelledCloud`'s example
    Traceback (most recent call last):
        ...
    og_pointcloud.errors.FeatureSpaceError: the label vectors are in feature space 'unknown' (dimension 3); expected ...
    """


class MissingExtraError(ImportError):
    """An optional dependency is absent, or cannot be loaded; the message names the extra that brings it, or the cause.

    >>> import og_pointcloud as og
    >>> str(og.MissingExtraError("laspy", "las"))
    "this needs laspy, which is not installed: pip install 'og-pointcloud[las]'"
    """

    def __init__(self, module: str, extra: str, cause: ImportError | None = None) -> None:
        wrong = "is not installed"
        if cause is not None and not isinstance(cause, (ModuleNotFoundError, MissingExtraError)):
            # It may lack a system library, or memory: then installing it does not help.
            wrong = f"cannot be loaded ({first_line(cause)}); remove the cause, or else"
        super().__init__(f"this needs {module}, which {wrong}: pip install 'og-pointcloud[{extra}]'")


NEEDED_FOR_FITS = ("numba", "scipy", "cv2", "PIL", "tqdm", "onnx")
"""Modules of the extra 'fit' that stages of a fit or a map import at module level."""


def missing_extra(error: Exception) -> MissingExtraError | None:
    """The error to raise if a base install lacks a module that fits or maps need; None for any other error."""
    module = (error.name or "").partition(".")[0] if isinstance(error, ModuleNotFoundError) else ""
    return MissingExtraError(module, "fit") if module in NEEDED_FOR_FITS else None


@contextmanager
def naming_extra(module: str, extra: str) -> Iterator[None]:
    """Raises MissingExtraError, which names the extra, if an import in the block fails."""
    try:
        yield
    except ImportError as error:
        raise MissingExtraError(module, extra, error) from error
