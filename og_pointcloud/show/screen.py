"""One browser's view of a live page: it draws the points itself or, if it is slow, is sent pictures of them.

Without a GPU a browser takes half a second to draw 300,000 points, even if only colors change. Once the server knows
which point each pixel shows, another picture of the same view is a look-up, and a word lights its points in a tenth of
a second. So every browser is timed when it gets a cloud, and a slow one is sent pictures: of a subset of the points
while the view moves, of all points when it rests.
"""

from __future__ import annotations

import base64
import threading
import time
from dataclasses import dataclass, replace
from typing import Any

import imageio.v3
import numpy as np
import viser
from numpy.typing import NDArray
from viser.transforms import SO3

from og_pointcloud.ask.picking import DrawnPoints, front_points
from og_pointcloud.formats.poses import rigid
from og_pointcloud.scene import Camera
from og_pointcloud.show.live import LiveScene

POINT_RADIUS_SPACINGS = 0.95
"""Radius of a point in spacings: large enough that surfaces look closed."""
SLOW_BROWSER_S = 0.15
"""A browser is slow if the points add more than this to the time of a requested picture, which takes two frames."""
PROBE_COUNT, PROBE_PX, PROBE_S = 3, (48, 64), 20.0
"""Number of pictures requested, of which the fastest counts; their height and width; and timeout of each: a hidden page
draws none."""
TURNING_VIEW_POINTS = 30_000
"""Approximate number of points in a picture while the view moves."""
REST_DELAY_S = 0.25
"""Seconds without camera motion until all points are drawn."""
BACKGROUND_DELAY_S = 1.0
"""Seconds without new colors until the canvas draws them too, which keeps a slow browser busy for half a second."""
JPEG_QUALITY = 92
BACKGROUND_RGB = np.full((1, 3), 255, np.uint8)
OVERLAY_HTML = (
    "<style>div:has(> canvas[data-engine])::after{{content:'';position:absolute;inset:0;pointer-events:none;"
    "background:url(data:image/jpeg;base64,{}) 0 0/100% 100%}}</style>"
)
"""A picture over the canvas, which costs a slow browser one frame. While the panel that contains it is folded, the
background drawn by the canvas itself is visible."""


@dataclass(frozen=True, eq=False)
class _Shown:
    """A scene that is shown. xyz: (N, 3) in the page's frame. size: factor of the point size."""

    live: LiveScene
    xyz: NDArray[np.float32]
    size: float

    @property
    def spacing(self) -> float:
        """Point spacing times the size factor."""
        return self.live.scene.cloud.spacing * self.size

    def subsampled(self, step: int) -> DrawnPoints:
        """Every step-th point, enlarged accordingly."""
        spacing = self.spacing * step**0.5
        return DrawnPoints(self.xyz[::step], np.zeros(3), spacing, self.live.scene.cloud.reach)


class Screen:
    """A browser's view of a scene. client: viser's handle of the browser."""

    def __init__(self, client: viser.ClientHandle) -> None:
        self._client = client
        self._lock = threading.RLock()  # guards what follows: page, timing and camera motion have threads of their own
        self._timing = threading.Lock()  # two timings at once would slow each other down
        self._shown: _Shown | None = None
        self._node: Any = None
        self._colors = BACKGROUND_RGB
        self._front: NDArray[np.int64] | None = None
        self._background_timer = threading.Timer(BACKGROUND_DELAY_S, lambda: None)
        self._overlay = client.gui.add_html("")
        self.sends_pictures, self._open, self._turned = False, True, threading.Event()
        client.camera.on_update(lambda _: self._turned.set())
        threading.Thread(target=self._follow, daemon=True).start()

    def show(self, live: LiveScene, middle: NDArray[np.float64], size: float) -> None:
        """Show the points of a scene. middle: (3,) the page's origin, world. size: of points, 1 by default."""
        with self._lock:
            xyz = (live.xyz - middle).astype(np.float32)  # browsers draw in float32
            self._shown = _Shown(live, xyz, size)
            self.sends_pictures, self._front, self._colors = False, None, live.colors()
            self._overlay.content = ""
            self._background_timer.cancel()
            self._client.scene.set_background_image(None)
            self._node = _add_points(self._client.scene, self._shown, self._colors)
            timing = threading.Thread(target=self._time, args=[self._node], daemon=True)
        timing.start()

    def paint(self, colors: NDArray[np.uint8]) -> None:
        """Color the points. colors: (N, 3) uint8."""
        with self._lock:
            self._colors = colors
            if self.sends_pictures:
                self._send(BACKGROUND_DELAY_S)
            elif hasattr(self._node, "colors"):
                self._node.colors = colors
            elif self._node.visible:
                self._node.rgbs = colors

    def resize(self, size: float) -> None:
        """Set the factor of the point size, 1 is normal."""
        with self._lock:
            if self._shown is None:
                return
            self._shown = replace(self._shown, size=size)
            if hasattr(self._node, "point_size"):
                self._node.point_size = POINT_RADIUS_SPACINGS * self._shown.spacing
        self._turned.set()

    def picture(self) -> NDArray[np.uint8]:
        """(H, W, 3 or 4) uint8: what the browser shows. Do not hold the page's lock: the browser may have to draw."""
        with self._lock:
            if self.sends_pictures and self._front is not None:
                return self._colored(self._front)
        return self._client.get_render(self._client.camera.image_height, self._client.camera.image_width)

    def close(self) -> None:
        """The browser has left."""
        self._open = False
        self._turned.set()

    # Pictures -------------------------------------------------------------------------------------------------------

    def _time(self, node: Any) -> None:
        """Switch to pictures if the browser draws these points slowly. node: viser's node of the points."""
        with self._timing:
            try:
                seconds = self._probe(node)
                if seconds > SLOW_BROWSER_S:  # subtract the time without points, such as the network's
                    self._switch(node, points=False)
                    seconds -= self._probe(node)
            except (RuntimeError, TimeoutError):  # the browser has left, or the page is hidden
                seconds = 0.0
            self._switch(node, points=seconds <= SLOW_BROWSER_S, pictures=seconds > SLOW_BROWSER_S)

    def _switch(self, node: Any, *, points: bool, pictures: bool = False) -> None:
        """Show points, pictures or neither. Does nothing if the points were replaced meanwhile, perhaps by others of
        the same scene, or if the browser has left: viser warns of data sent then."""
        with self._lock:
            if self._open and self._node is node and self._shown is not None:
                self.sends_pictures = pictures
                if hasattr(node, "colors"):
                    node.visible = points
                # Hidden splats take a browser as long as visible ones: they are removed, and added again.
                elif node.visible and not points:
                    node.visible = False
                    node.remove()
                elif points and not node.visible:
                    self._node = _add_points(self._client.scene, self._shown, self._colors)
        self._turned.set()

    def _probe(self, node: Any) -> float:
        """Seconds until a small picture arrives; 0 if the browser has left, or the points were replaced by others,
        which are timed separately."""
        seconds = []
        for _ in range(PROBE_COUNT):
            if not self._open or self._node is not node:
                return 0.0
            start = time.monotonic()
            self._client.get_render(*PROBE_PX, timeout=PROBE_S)
            seconds.append(time.monotonic() - start)
        return min(seconds)

    def _follow(self) -> None:
        """Draw what a slow browser's camera sees, whenever it has moved."""
        while self._turned.wait() and self._open:
            self._turned.clear()
            shown = self._shown
            if not self.sends_pictures or shown is None:
                continue
            step = 1 + len(shown.xyz) // TURNING_VIEW_POINTS
            self._draw(shown, step)
            if step > 1 and not self._turned.wait(REST_DELAY_S):
                self._draw(shown, 1)

    def _draw(self, shown: _Shown, step: int) -> None:
        """Find which point each pixel shows, among every step-th point, and send the picture."""
        camera = self._camera()
        if camera is None:
            return
        front = front_points(shown.subsampled(step), camera)
        front[front >= 0] *= step
        with self._lock:
            if self.sends_pictures and shown is self._shown:
                self._front = front
                self._send()

    def _camera(self) -> Camera | None:
        """The browser's camera in the page's frame; None while its window has no size."""
        camera = self._client.camera
        width, height = camera.image_width, camera.image_height
        if not width or not height:
            return None
        rotation = SO3(np.asarray(camera.wxyz, np.float64)).as_matrix().T
        pose = rigid(rotation, -rotation @ np.asarray(camera.position, np.float64))
        focal_px = height / 2 / np.tan(camera.fov / 2)
        return Camera(width, height, focal_px, focal_px, width / 2, height / 2, pose)

    def _send(self, wait_s: float = 0.0) -> None:
        """Send the picture of the view in the current colors. wait_s: seconds until the canvas draws it too."""
        if self._front is not None and self._open:
            picture = self._colored(self._front)
            file = imageio.v3.imwrite("<bytes>", picture, extension=".jpg", quality=JPEG_QUALITY)
            self._overlay.content = OVERLAY_HTML.format(base64.b64encode(file).decode())
            self._client.flush()
            self._background_timer.cancel()
            self._background_timer = threading.Timer(wait_s, self._draw_background)
            self._background_timer.daemon = True
            self._background_timer.start()

    def _draw_background(self) -> None:
        """Make the canvas draw the current picture, unless points are shown: timers may fire late."""
        with self._lock:
            if self.sends_pictures and self._open and self._front is not None:
                self._client.scene.set_background_image(self._colored(self._front), "jpeg", jpeg_quality=JPEG_QUALITY)
                self._client.flush()

    def _colored(self, front: NDArray[np.int64]) -> NDArray[np.uint8]:
        """(H, W, 3) uint8: the current colors of the points that the pixels show."""
        palette = np.concatenate([self._colors, BACKGROUND_RGB])
        return palette.take(front, axis=0, mode="wrap")  # NO_POINT, -1, reads the background


def _add_points(scene: viser.SceneApi, shown: _Shown, colors: NDArray[np.uint8]) -> Any:
    """Add the points as splats if they are Gaussians, else as discs."""
    splats = shown.live.shown
    if splats is None or splats.scale is None or splats.rotation is None or splats.opacity is None:
        return scene.add_point_cloud(
            "/scene", shown.xyz, colors, point_size=POINT_RADIUS_SPACINGS * shown.spacing, point_shape="circle",
            precision="float32", point_shading="flat",
        )  # fmt: skip
    # Covariance R S S R' of each splat; S holds the standard deviations along its axes (3DGS).
    axes = SO3(splats.rotation).as_matrix() * splats.scale[:, None, :]
    covariances = axes @ axes.transpose(0, 2, 1)
    return scene.add_gaussian_splats("/scene", shown.xyz, covariances, colors / 255, splats.opacity[:, None])
