"""Open3D itself: imported in one place, so that whatever is wrong with it is said in one sentence."""

from __future__ import annotations

import importlib
import re
from typing import Any

from og_pointcloud.errors import MissingExtraError, OgPointcloudError

__all__ = ["OLDEST", "open3d"]

OLDEST = (0, 19)
DEBIAN_LIBRARIES = "libusb-1.0-0 libgl1 libegl1 libx11-6 libgomp1"


def open3d() -> Any:
    """The module. MissingExtraError where it is not installed, OgPointcloudError where it is too old or cannot load."""
    try:
        module = importlib.import_module("open3d")
    except ModuleNotFoundError as error:
        raise MissingExtraError(error.name or "open3d", "open3d") from None
    except (ImportError, OSError) as error:
        raise OgPointcloudError(
            f"Open3D is installed but does not load ({str(error).splitlines()[0]}): install the system libraries it "
            f"needs, on Debian and Ubuntu: apt-get install {DEBIAN_LIBRARIES}"
        ) from None
    if tuple(map(int, re.findall(r"\d+", module.__version__)[:2])) < OLDEST:
        oldest = "{}.{}".format(*OLDEST)
        raise OgPointcloudError(
            f"Open3D is {module.__version__}; this plugin needs {oldest} or later: pip install 'open3d>={oldest}'"
        )
    return module
