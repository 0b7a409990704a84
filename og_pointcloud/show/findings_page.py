"""Findings of a search as a page with a picture of each, drawn from its scene's points if the file still exists."""

from __future__ import annotations

import base64
import html
import struct
import zlib

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.ask.labelled_scene import as_scene
from og_pointcloud.ask.picking import DrawnPoints, front_points
from og_pointcloud.cloud import LabelledCloud
from og_pointcloud.collection.collection import Collection, Finding, Findings
from og_pointcloud.errors import OgPointcloudError, coordinate
from og_pointcloud.formats.atomic import StrPath, write_file
from og_pointcloud.show.viewpoint import Viewpoint

SIDE_PX = 200
MARGIN_SHARE = 0.35
"""Margin shown around an instance, as a share of its largest length."""
MAX_POINTS = 60_000
"""Points that a picture is drawn from."""
EYE_DIRECTION, UP_DIRECTION = np.array([1.0, -1.4, 1.1]), np.array([0.0, 0.0, 1.0])
"""Direction from the instance to the eye; z is up, the default of `og-pointcloud view`."""
EYE_DISTANCE_WIDTHS = 20.0
"""Distance of the eye, in widths of the picture: hardly any perspective."""
BACKGROUND_GRAY = 250
FADE_SHARE = 0.6
"""Share of the background mixed into the points around the instance."""
HIGHLIGHT = (214, 90, 40)
"""Color of the instance in clouds without colors."""

PAGE = """<!doctype html><html><head><meta charset="utf-8"><title>{title}</title><style>
body {{ font: 15px/1.4 system-ui, sans-serif; margin: 2em; color: #222; background: #fff }}
main {{ display: grid; grid-template-columns: repeat(auto-fill, minmax(200px, 1fr)); gap: 1.2em }}
figure {{ margin: 0 }} img, .none {{ width: 100%; aspect-ratio: 1; border-radius: 6px; background: #fafafa }}
.none {{ display: grid; place-items: center; color: #999 }} figcaption {{ font-size: 13px }}
b {{ font-size: 15px }} .score {{ float: right }} .misfit {{ opacity: 0.4 }}
</style></head><body><h1>{title}</h1><p>{notes}</p><main>
{cards}
</main></body></html>
"""


def write_findings(path: StrPath, collection: Collection, findings: Findings, title: str) -> None:
    """Write the page atomically. title: the query."""
    fitting = f"{sum(finding.fits for finding in findings)} of these {len(findings)} fit; pale ones do not"
    text = PAGE.format(
        title=html.escape(title),
        notes="<br>".join(map(html.escape, [fitting, *findings.not_asked])),
        cards="\n".join(_card(rank, finding, collection) for rank, finding in enumerate(findings, 1)),
    )
    write_file(path, text.encode())


def _card(rank: int, finding: Finding, collection: Collection) -> str:
    try:
        cloud = as_scene(collection.file(finding.scene)).cloud
        png = base64.b64encode(picture(cloud, finding)).decode()
        shown = f'<img alt="instance {finding.instance}" src="data:image/png;base64,{png}">'
    except (OgPointcloudError, OSError):  # moved or rewritten since: the finding itself stays valid for that time
        shown = '<div class="none">file not found</div>'
    center, size = ", ".join(map(coordinate, finding.center)), ", ".join(f"{value:.3g}" for value in finding.size)
    kind = "" if finding.fits else " class=misfit"
    return (
        f'<figure{kind}>{shown}<figcaption><span class="score">{finding.score:.3f}</span><b>{rank}. '
        f"{html.escape(finding.word)}</b><br>{html.escape(finding.scene)}, instance {finding.instance}<br>"
        f"at {center}<br>size {size}</figcaption></figure>"
    )


def picture(cloud: LabelledCloud, finding: Finding) -> bytes:
    """A square PNG of an instance and its surroundings, seen obliquely from far above."""
    half = np.array(finding.size) / 2
    reach = half + MARGIN_SHARE * max(2 * half.max(), 8 * cloud.spacing)
    # The instance's center is the picture's origin.
    local = cloud.xyz - (np.array(finding.center) - cloud.origin).astype(np.float32)
    rows = np.flatnonzero((np.abs(local) <= reach).all(axis=1))
    rows = rows[:: 1 + len(rows) // MAX_POINTS]
    in_instance = cloud.instance_ids[rows] == finding.instance
    if cloud.rgb is None:
        colors = np.where(in_instance[:, None], HIGHLIGHT, 150).astype(float)
    else:
        colors = cloud.rgb[rows].astype(float)
    colors[~in_instance] += FADE_SHARE * (BACKGROUND_GRAY - colors[~in_instance])
    shown = DrawnPoints(local[rows], np.zeros(3), cloud.spacing, cloud.reach)
    eye = EYE_DISTANCE_WIDTHS * 2 * np.linalg.norm(reach) * EYE_DIRECTION / np.linalg.norm(EYE_DIRECTION)
    camera = Viewpoint(eye, np.zeros(3), UP_DIRECTION).camera(SIDE_PX, SIDE_PX, EYE_DISTANCE_WIDTHS * SIDE_PX)
    palette = np.append(colors, [[BACKGROUND_GRAY] * 3], axis=0).astype(np.uint8)
    return png_bytes(palette[front_points(shown, camera)])  # -1, no point, is the last


def png_bytes(image: NDArray[np.uint8]) -> bytes:
    """An image (H, W, 3) as PNG, with numpy and zlib alone."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    height, width = image.shape[:2]
    rows = np.concatenate([np.zeros((height, 1), np.uint8), image.reshape(height, -1)], axis=1)  # 0: no filter
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    body = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows.tobytes(), 6)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + body
