"""A live page of scenes: type any word, click a thing to identify it, choose the colors. Needs the extra 'serve'.

viser shows the points and the controls; ``live`` computes the answers. Everybody who opens the page sees the same. By
default it is served to this machine alone: there is no password.
"""

from __future__ import annotations

import html
import io
import socket
import threading
from collections.abc import Callable, Mapping
from contextlib import redirect_stdout
from dataclasses import dataclass
from typing import Any

import imageio.v3
import numpy as np
import viser

from og_pointcloud.ask.boxes import unit_up
from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.show.live import Answer, LiveScene
from og_pointcloud.show.screen import Screen
from og_pointcloud.show.viewpoint import FOCAL, are_no_strays, choose_viewpoint

LOOPBACK, PORT, PORT_COUNT = "127.0.0.1", 8080, 1 << 16
HEIGHT_PX = 640
"""Height of the page in a notebook."""
MAX_INSTANCES_LISTED = 300
"""Instances in the list: the largest ones."""
ALL_INSTANCES = "all"
TITLE = "og_pointcloud"
ROW = '<div style="display:flex;gap:8px;align-items:center;padding:1px 0">{}</div>'
SWATCH = '<i style="flex:none;width:12px;height:12px;border-radius:50%;background:rgb{}"></i>'
SIDE = '<span style="margin-left:auto;opacity:.6">{}</span>'
BAR = (
    ROW.format("<span>{}</span>" + SIDE.format("{:.2f}"))
    + '<progress style="display:block;width:100%;height:5px" value="{}"></progress>'
)
GREY = '<div style="opacity:.6">{}</div>'
CARD = '<div style="padding:0 12px 8px;font-size:13px;overflow-wrap:anywhere">{}</div>'


@dataclass(frozen=True)
class ServeSettings:
    """host: the address to listen on; "0.0.0.0" lets others in. port: the first to try. up: (3,) upward direction."""

    host: str = LOOPBACK
    port: int = PORT
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)


def serve(scenes: Mapping[str, LiveScene], settings: ServeSettings | None = None) -> LivePage:
    """Start a page of one or more scenes, given by title, and return at once.

    OgPointcloudError if a scene has no point to show, or the address cannot be listened on.
    """
    empty = [title for title, live in scenes.items() if len(live.xyz) == 0]
    if empty or not scenes:
        raise OgPointcloudError(f"{', '.join(empty) or 'no scene'} has no points to show; expected at least one")
    settings = settings or ServeSettings()
    unit_up(settings.up)  # raises if it is no direction
    _check_address(settings.host, settings.port)
    return LivePage(scenes, settings)


def _check_address(host: str, port: int) -> None:
    """Refuse an address that is not this machine's: viser would silently try port after port."""
    try:
        socket.create_server((host, 0), family=socket.AF_INET6 if ":" in host else socket.AF_INET).close()
    except OSError as error:
        cure = "expected an address of this machine, such as 127.0.0.1, or 0.0.0.0 for all addresses"
        raise OgPointcloudError(f"cannot listen on '{host}' ({error}); {cure}") from None
    if not 0 <= port < PORT_COUNT:
        raise OgPointcloudError(f"the port is {port}; expected a number from 0, for any free port, to {PORT_COUNT - 1}")


def show(scene: Any, labels: Any = None, *, text_features: Any = None) -> LivePage:
    """A page of one scene, on this machine; a notebook shows it in its cell. Arguments as for ``segment``."""
    title = scene.path.stem if scene.path else "scene"
    return serve({title: LiveScene(scene, labels=labels, text_features=text_features)})


class LivePage:
    """A page that is being served at ``url``. ``stop`` ends it."""

    def __init__(self, scenes: Mapping[str, LiveScene], settings: ServeSettings) -> None:
        self._scenes, self._settings = dict(scenes), settings
        self._lock = threading.RLock()  # viser calls from several threads
        with redirect_stdout(io.StringIO()):  # viser prints a box with the addresses even if verbose is False
            self._server = viser.ViserServer(settings.host, settings.port, TITLE, verbose=False)
        self._live = next(iter(self._scenes.values()))
        self._server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
        self._server.gui.main_panel.dock_right()
        self._server.scene.set_up_direction(settings.up)
        self._server.scene.on_click()(self._clicked)
        self._screens: dict[int, Screen] = {}
        self._add_controls()
        self._show_scene()
        self._server.on_client_connect(self._client_connected)
        self._server.on_client_disconnect(self._client_left)

    @property
    def url(self) -> str:
        """Address of the page for a browser on this machine."""
        host = LOOPBACK if self._settings.host in ("0.0.0.0", "::") else self._settings.host
        return f"http://{f'[{host}]' if ':' in host else host}:{self._server.get_port()}"

    @property
    def is_open(self) -> bool:
        """Whether other machines can reach it."""
        return self._settings.host not in ("127.0.0.1", "localhost", "::1")

    def wait(self) -> None:
        """Serve until interrupted (Ctrl-C), then stop."""
        try:
            threading.Event().wait()
        except KeyboardInterrupt:
            pass
        finally:
            self.stop()

    def stop(self) -> None:
        """End the page; browsers show that the connection is lost."""
        for screen in list(self._screens.values()):
            screen.close()
        with redirect_stdout(io.StringIO()):
            self._server.stop()

    def _repr_html_(self) -> str:
        return f'<iframe src="{self.url}" width="100%" height="{HEIGHT_PX}" style="border:0"></iframe>'

    # Controls -------------------------------------------------------------------------------------------------------

    def _add_controls(self) -> None:
        gui = self._server.gui
        if len(self._scenes) > 1:
            self._choice = gui.add_dropdown("scene", tuple(self._scenes))
            self._choice.on_update(self._guarded(self._change_scene))
        with gui.add_form(None) as form:
            self._word = gui.add_text("find", "", hint="stored words as you type, others with Enter")
        form.on_submit(self._guarded(self._ask))
        self._word.on_update(self._guarded(self._typed))
        self._answer = gui.add_html("")
        self._mode = gui.add_dropdown("colors", self._live.modes)
        self._mode.on_update(self._guarded(self._change_mode))
        self._list: Any = gui.add_dropdown("instance", (ALL_INSTANCES,))
        self._list.on_update(self._guarded(self._chosen))
        self._size = gui.add_slider("point size", 0.3, 4.0, 0.05, 1.0)
        self._size.on_update(self._guarded(self._resize))
        gui.add_button("picture").on_click(self._photograph)
        self._legend = gui.add_html("")

    def _guarded(self, act: Callable[[], None]) -> Callable[[Any], None]:
        """A handler for viser: runs one at a time, and only for a user's action, not for values set by the page."""

        def called(event: Any) -> None:
            if event.client is not None:
                with self._lock:
                    act()

        return called

    def _typed(self) -> None:
        """Stored words and empty text are answered while typing; others may need an encoder, and wait for Enter."""
        own = self._live.scene.vocabulary
        if not self._word.value.strip() or (own and self._word.value.strip() in own.names):
            self._ask()

    def _ask(self) -> None:
        self._show_answer(self._live.ask(self._word.value))
        self._list.value = ALL_INSTANCES

    def _chosen(self) -> None:
        row = self._list.value
        if row not in self._list.options:
            return  # another browser has just changed the scene
        self._word.value = ""
        self._show_answer(self._live.ask("") if row == ALL_INSTANCES else self._live.choose(int(row.split(" ")[0])))

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        camera = event.client.camera
        focal_px = camera.image_height / 2 / np.tan(camera.fov / 2)
        with self._lock:
            eye = np.array(event.ray_origin) + self._middle
            self._show_answer(self._live.click(eye, np.array(event.ray_direction), focal_px))
            self._word.value, self._list.value = "", ALL_INSTANCES

    def _change_mode(self) -> None:
        self._live.mode = self._mode.value
        self._legend.content = legend_html(self._live)
        self._paint()

    def _change_scene(self) -> None:
        self._live = self._scenes[self._choice.value]
        self._show_scene()

    def _photograph(self, event: viser.GuiEvent) -> None:
        """Send the requesting browser its current view as a PNG to save."""
        client = event.client
        if client is None or client.client_id not in self._screens:
            return
        try:
            picture = self._screens[client.client_id].picture()
        except RuntimeError:  # the browser has left before it drew
            return
        file = imageio.v3.imwrite("<bytes>", picture, extension=".png")
        client.send_file_download(f"{TITLE}.png", file, save_immediately=True)

    # What is shown --------------------------------------------------------------------------------------------------

    def _show_scene(self) -> None:
        """Put the scene's points, camera and lists into the page."""
        live = self._live
        placed = live.xyz[are_no_strays(live.xyz)]
        low, high = placed.min(axis=0), placed.max(axis=0)
        self._middle = low + (high - low) / 2  # the page's origin
        view = choose_viewpoint(live.xyz, live.label_of[live.ids] >= 0, unit_up(self._settings.up))
        camera = self._server.initial_camera
        camera.fov, camera.up = 2 * float(np.arctan(1 / FOCAL)), view.up
        camera.position, camera.look_at = view.eye - self._middle, view.target - self._middle
        extent = float(np.linalg.norm(high - low)) or 1.0
        camera.near, camera.far = extent / 1e4, 10 * extent
        for client in self._server.get_clients().values():
            client.camera.position, client.camera.look_at = camera.position, camera.look_at
        for screen in self._screens.values():
            screen.show(live, self._middle, self._size.value)
        self._mode.options, self._mode.value = live.modes, live.mode
        rows = [row for row in live.instances.largest(MAX_INSTANCES_LISTED) if row.points]
        self._list.options = (ALL_INSTANCES, *(f"{row.id} · {live.name_of(row.id)} · {row.points:,}" for row in rows))
        self._word.value, self._list.value = "", ALL_INSTANCES
        self._legend.content = legend_html(live)
        self._show_answer(live.ask(""))

    def _client_connected(self, client: viser.ClientHandle) -> None:
        with self._lock:
            if client.client_id not in self._server.get_clients():
                return  # it has already left: the two events come from different threads
            screen = self._screens[client.client_id] = Screen(client)
            screen.show(self._live, self._middle, self._size.value)

    def _client_left(self, client: viser.ClientHandle) -> None:
        with self._lock:
            if screen := self._screens.pop(client.client_id, None):
                screen.close()

    def _resize(self) -> None:
        for screen in self._screens.values():
            screen.resize(self._size.value)

    def _paint(self) -> None:
        colors = self._live.colors()
        for screen in self._screens.values():
            screen.paint(colors)

    def _show_answer(self, answer: Answer) -> None:
        """Show an answer and its colors. With points, the text is sent first: a browser shows it at once, the colors
        with its next frame. With pictures, both are sent together: an extra frame would delay the picture."""
        with_pictures = any(screen.sends_pictures for screen in self._screens.values())
        if with_pictures:
            self._paint()
        self._answer.content = answer_html(answer)
        self._server.flush()
        if not with_pictures:
            self._paint()


def answer_html(answer: Answer) -> str:
    """The answer as HTML. Names come from files, so they are escaped."""
    title, *lines, note = map(html.escape, (answer.title, *answer.lines, answer.note))
    bars = [BAR.format(html.escape(name), score, score) for name, score in answer.bars]
    return CARD.format("".join([f"<b>{title}</b>", *map(GREY.format, lines), *bars, GREY.format(note)]))


def legend_html(live: LiveScene) -> str:
    """Labels with their colors and numbers of points."""
    rows = [
        ROW.format(SWATCH.format(tuple(color)) + f"<span>{html.escape(name)}</span>" + SIDE.format(f"{count:,}"))
        for name, color, count in live.legend()
    ]
    return CARD.format("".join(rows))
