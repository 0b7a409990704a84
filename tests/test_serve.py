"""The live page: who can reach it, what is refused, and a browser that types and clicks."""

import base64
import importlib
import shutil
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from commands import error_of
from labelled_clouds import make_cloud, room
from og_pointcloud_export import write_bundle
from test_view import content

import og_pointcloud as og
from og_pointcloud.ask.picking import front_points
from og_pointcloud.cli import main
from og_pointcloud.cloud import Vocabulary
from og_pointcloud.show.changes_page import both_visits, write_changes_page
from og_pointcloud.show.live import CHANGES, Answer, LiveScene
from og_pointcloud.show.viewpoint import Viewpoint

BROWSER = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-background-networking"]


@pytest.fixture
def pages():
    """The module that serves, where viser is installed."""
    pytest.importorskip("viser")
    return importlib.import_module("og_pointcloud.show.serve")


@pytest.fixture
def live():
    return LiveScene(og.LabelledScene.from_cloud(room(300)))


@pytest.fixture
def page(pages, live):
    """A page that shows ``live``."""
    page = pages.serve({"room": live}, pages.ServeSettings(port=0))
    yield page
    page.stop()


@pytest.fixture
def window():
    """An empty page of a browser."""
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no Chromium here")
    playwright = pytest.importorskip("playwright.sync_api")
    with playwright.sync_playwright() as play:
        started = play.chromium.launch(executable_path=browser, args=BROWSER)
        yield started.new_page(viewport={"width": 900, "height": 600})


def listens_at(port):
    """Addresses with a socket that listens at the port, as Linux has them."""
    rows = [
        line.split() for table in ("tcp", "tcp6") for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]
    ]
    return {row[1].split(":")[0] for row in rows if row[3] == "0A" and int(row[1].split(":")[1], 16) == port}


@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="only Linux tells who listens")
def test_it_listens_on_this_machine_alone_unless_told_otherwise(pages, live, capsys):
    for host, address, is_open in (("127.0.0.1", "0100007F", False), ("0.0.0.0", "00000000", True)):
        page = pages.serve({"room": live}, pages.ServeSettings(host, 0))
        try:
            assert page.is_open == is_open
            assert page.url.startswith("http://127.0.0.1:")
            assert listens_at(int(page.url.rsplit(":", 1)[1])) == {address}
        finally:
            page.stop()
    assert capsys.readouterr().out == ""


def test_a_word_of_any_length_is_answered_in_a_few_lines(pages, live):
    answer = live.ask("chair" * 2000)
    assert len(answer.title) < 100
    assert all("is not among the" in line and len(line) < 1000 for line in answer.lines)


def test_an_answer_is_sent_before_colors_are_made(pages, live, page, monkeypatch):
    """A browser shows what stands in the panel at once if no color is sent with it."""
    sent, colors = [], live.colors
    monkeypatch.setattr(page._server, "flush", lambda: sent.append(page._answer.content))
    monkeypatch.setattr(live, "colors", lambda: sent.append("colors") or colors())
    page._word.value = "plum"
    page._ask()
    assert sent == [pages.answer_html(live.ask("plum")), "colors"]


def test_beside_pictures_an_answer_waits_for_the_picture(pages, live, page, monkeypatch):
    """Two frames of a slow browser would take twice the time."""
    sent = []
    slow = SimpleNamespace(sends_pictures=True, paint=lambda colors: sent.append(page._answer.content), close=print)
    page._screens[0] = slow
    before, page._word.value = page._answer.content, "plum"
    monkeypatch.setattr(page._server, "flush", lambda: sent.append(page._answer.content))
    page._ask()
    assert sent == [before, pages.answer_html(live.ask("plum"))]


def test_a_browser_that_has_left_before_it_is_welcomed_gets_no_screen(page):
    """Both are told from threads, in any order; what is kept for it would never be let go."""
    gone = SimpleNamespace(client_id=7)
    page._client_left(gone)
    page._client_connected(gone)
    assert page._screens == {}


def test_a_browser_that_leaves_before_it_has_drawn_its_picture_gets_none(page):
    """viser then raises, in a thread of its own, and would print a traceback into the terminal that serves."""

    def leaves():
        raise RuntimeError("the client disconnected before returning a frame")

    sent = []
    page._screens[7] = SimpleNamespace(picture=leaves, close=print)
    page._photograph(SimpleNamespace(client=SimpleNamespace(client_id=7, send_file_download=sent.append)))
    assert sent == []


def test_an_instance_chosen_of_the_scene_before_lights_nothing(live, page):
    """One browser changes the scene while another chooses from its list."""
    for of_another_scene in ("1 · plum · 7", "1000 · plum · 7"):
        page._list._impl.value = of_another_scene  # as viser sets what a browser sends
        page._chosen()
        assert live.lit is None


def test_a_stray_at_the_origin_of_the_map_moves_no_point_of_the_page(pages):
    """The page's origin was half way to it, where the browser's float32 has steps of 25 cm, and near was 500 m away."""
    cloud = room(300)
    strayed = np.vstack([cloud.xyz, np.float32([[-4e5, -5.4e6, -300]])])
    ids, origin = np.append(cloud.instance_ids, -1), np.array([4e5, 5.4e6, 300])
    moved = replace(cloud, xyz=strayed, origin=origin, instance_ids=ids, rgb=None, certainty=None)
    page = pages.serve({"room": LiveScene(og.LabelledScene.from_cloud(moved))}, pages.ServeSettings(port=0))
    try:
        assert np.abs(page._middle - origin).max() < 10
        assert page._server.initial_camera.near < 0.01
    finally:
        page.stop()


def test_a_notebook_shows_the_page_in_its_cell(pages):
    page = og.LabelledScene.from_cloud(room(300)).show(["plum"])
    try:
        assert f'<iframe src="{page.url}"' in page._repr_html_()
        assert not page.is_open
    finally:
        page.stop()


def test_text_of_a_file_is_never_html(pages):
    name = "<img src=x onerror=alert(1)>"
    cloud = room(300)
    cloud = replace(cloud, vocabulary=Vocabulary((name, *cloud.vocabulary.names[1:]), cloud.vocabulary.vectors))
    live = LiveScene(og.LabelledScene.from_cloud(cloud))
    for text in (
        pages.answer_html(live.ask("")),
        pages.legend_html(live),
        pages.answer_html(Answer(name, (name,), ((name, 2.0),), name)),
    ):
        assert "&lt;img src=x onerror" in text
        assert name not in text


def test_the_legend_has_the_colors_of_the_points(pages, live):
    shown = pages.legend_html(live)
    for name, color, count in live.legend():
        red, green, blue = color
        assert f'background:rgb({red}, {green}, {blue})"></i><span>{name}</span>' in shown
        assert f">{count:,}</span>" in shown


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--host", "203.0.113.5"], "cannot listen on '203.0.113.5'"),
        (["--host", "no such host"], "cannot listen on 'no such host'"),
        (["--port", "99999"], "the port is 99999; expected a number from 0"),
        (["--labels", "appel"], "did you mean 'apple'"),
        (["room.ogpc", "--cloud", "x.ply"], "--cloud is for one scene, but 2 are given"),
    ],
)
def test_bad_use_is_refused_in_one_line(pages, bundle, capsys, monkeypatch, options, said):
    monkeypatch.chdir(bundle.parent)
    assert said in error_of(capsys, "serve", bundle, *options)


def test_an_empty_scene_is_refused(pages, live, tmp_path, capsys):
    empty = write_bundle(make_cloud(np.zeros((0, 3)), []), tmp_path / "empty.ogpc")
    assert "empty has no points to show" in error_of(capsys, "serve", empty)

    with pytest.raises(og.SceneError, match=r"up is \(0, 0, 0\); expected a direction"):
        pages.serve({"room": live}, pages.ServeSettings(up=(0, 0, 0)))


def test_without_viser_the_extra_is_named(bundle, capsys, monkeypatch):
    monkeypatch.delitem(sys.modules, "og_pointcloud.show.serve", raising=False)
    monkeypatch.setitem(sys.modules, "viser", None)
    assert "og-pointcloud[serve]" in error_of(capsys, "serve", bundle)
    with pytest.raises(og.MissingExtraError, match="serve"):
        og.load(bundle).show()


@pytest.mark.slow
def test_the_command_says_who_can_reach_it_and_ends_when_interrupted(pages, bundle):
    command = [sys.executable, "-u", "-m", "og_pointcloud", "serve"]
    process = subprocess.Popen(
        [*command, bundle, "--port", "0"],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        # Of a shell's background jobs children inherit that interrupts are ignored.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    try:
        lines = iter(process.stdout.readline, "")
        assert any(line.startswith("http://127.0.0.1:") for line in lines)
        assert next(lines) == "for this machine only; --host 0.0.0.0 lets others in, without a password\n"
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0
        assert "Traceback" not in process.stdout.read()
    finally:
        process.kill()


def picture_of(data):
    """(H, W, 3) int RGB of the bytes of a PNG."""
    import cv2

    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1].astype(int)


def until(true, seconds=60):
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "the page did not get there"
        time.sleep(0.2)


class Browser:
    """In viser's place: a browser that takes so many seconds for a picture with points, and without them."""

    def __init__(self, monkeypatch, with_points, without):
        self.seconds, self.clock, self.drawn, self.pictures = (without, with_points), 0.0, None, []
        self.scene = self.gui = self
        eye = Viewpoint(np.array([2.0, 1.5, 2.5]), np.zeros(3), np.array([0, 0, 1.0]))
        self.seen_by = eye.camera(160, 120, 100)
        from viser.transforms import SO3

        self.camera = SimpleNamespace(
            on_update=lambda turned: setattr(self, "turned", turned),
            image_width=160, image_height=120, fov=2 * np.arctan(60 / 100), position=eye.eye,
            wxyz=SO3.from_matrix(self.seen_by.world_to_camera[:3, :3].T).wxyz,
        )  # fmt: skip
        monkeypatch.setattr("og_pointcloud.show.screen.time", SimpleNamespace(monotonic=lambda: self.clock))

    def add_point_cloud(self, name, xyz, colors, **_):
        self.drawn = SimpleNamespace(colors=colors, visible=True)
        return self.drawn

    def add_gaussian_splats(self, name, xyz, shapes, rgbs, opacities):
        node = SimpleNamespace(rgbs=rgbs, visible=True)
        node.remove = lambda: setattr(self, "drawn", None)  # while hidden ones are drawn at full cost
        self.drawn = node
        return node

    def set_background_image(self, picture, *_, **__):
        self.background = picture

    def add_html(self, content):
        return self

    @property
    def content(self):
        return self.html

    @content.setter
    def content(self, html):
        self.html = html
        if html:
            self.pictures.append(picture_of(base64.b64decode(html.split("base64,")[1].split(")")[0])))

    def get_render(self, height, width, timeout):
        seconds = self.seconds[self.drawn is not None and (self.drawn.visible or hasattr(self.drawn, "rgbs"))]
        if seconds > timeout:
            raise TimeoutError
        self.clock += seconds

    def flush(self):
        pass


@pytest.fixture
def shown_in(pages, monkeypatch):
    """A scene as browsers of some speed show it: the scene, the browser and its screen, once it was timed."""
    from og_pointcloud.show.screen import Screen

    screens = []

    def shown(with_points, without, count=300, points=None):
        browser = Browser(monkeypatch, with_points, without)
        live = LiveScene(og.LabelledScene.from_cloud(room(count)), points)
        timed = threading.Event()
        monkeypatch.setattr(Screen, "_time", lambda *args, time=Screen._time: (time(*args), timed.set()))
        screens.append(Screen(browser))
        screens[-1].show(live, np.zeros(3), 1.0)
        assert timed.wait(60)
        return live, browser, screens[-1]

    yield shown
    for screen in screens:
        screen.close()


@pytest.mark.parametrize("kind", ["points", "splats"])
@pytest.mark.parametrize(("with_points", "without", "slow"), [
    (0.02, 0.01, False), (0.9, 0.8, False), (0.9, 0.1, True), (np.inf, np.inf, False)
], ids=["quick", "far away", "slow", "not looked at"])  # fmt: skip
def test_a_browser_that_draws_slowly_is_sent_pictures(shown_in, with_points, without, slow, kind):
    from test_formats_spz import splats

    live, browser, screen = shown_in(with_points, without, points=splats(300) if kind == "splats" else None)
    live.ask("plum")
    screen.paint(live.colors())
    assert screen.sends_pictures == slow
    if slow:
        until(lambda: browser.html)
        assert browser.drawn is None if kind == "splats" else not browser.drawn.visible
        return
    assert browser.drawn.visible
    assert np.array_equal(browser.drawn.rgbs if kind == "splats" else browser.drawn.colors, live.colors())
    assert (browser.html, browser.background) == ("", None)


def test_a_picture_shows_the_points_as_they_are_colored(shown_in):
    live, browser, screen = shown_in(0.9, 0.1)
    until(lambda: browser.pictures)
    front = front_points(live.scene.cloud, browser.seen_by)
    assert (front >= 0).sum() > 500
    for word in ("", "plum"):
        live.ask(word)
        screen.paint(live.colors())
        assert np.array_equal(screen.picture(), np.append(live.colors(), [[255] * 3], axis=0)[front])
        until(lambda: np.array_equal(browser.background, screen.picture()))  # which a folded panel leaves
    error = [np.abs(sent.astype(int) - screen.picture()).mean() for sent in browser.pictures[-2:]]
    assert error[1] < 0.5 * error[0]  # JPEG's, and another word's
    screen.resize(2.0)
    until(lambda: (screen.picture() != 255).any(axis=2).sum() > 1.2 * (front >= 0).sum())


def test_while_the_view_turns_a_picture_is_of_fewer_points(shown_in, monkeypatch):
    drawn = []
    monkeypatch.setattr("og_pointcloud.show.screen.TURNING_VIEW_POINTS", 200)
    monkeypatch.setattr(
        "og_pointcloud.show.screen.front_points",
        lambda points, camera: drawn.append(points) or front_points(points, camera),
    )
    live, browser, _screen = shown_in(0.9, 0.1, count=1000)
    until(lambda: len(drawn) == 2)
    browser.turned(None)
    until(lambda: len(drawn) == 4)
    assert [len(points.xyz) for points in drawn] == [len(live.xyz[::step]) for step in (6, 1, 6, 1)]
    assert np.allclose([points.spacing for points in drawn[:2]], live.scene.cloud.spacing * np.sqrt([6, 1]))
    assert np.array_equal(drawn[0].xyz, live.xyz[::6].astype(np.float32))


def test_a_timing_of_points_that_were_replaced_changes_nothing(pages, monkeypatch):
    """The scene is changed and changed back while the first timing waits for the browser."""
    from og_pointcloud.show.screen import PROBE_COUNT, Screen

    browser, timed, asked, hold = Browser(monkeypatch, 0.9, 0.1), threading.Semaphore(0), [], threading.Event()
    monkeypatch.setattr(Screen, "_time", lambda *args, time=Screen._time: (time(*args), timed.release()))
    render = browser.get_render

    def get_render(*args, **options):
        asked.append(args)
        if len(asked) == 1:
            assert hold.wait(60)
        return render(*args, **options)

    browser.get_render = get_render
    first, other = (LiveScene(og.LabelledScene.from_cloud(room(300))) for _ in range(2))
    screen = Screen(browser)
    try:
        screen.show(first, np.zeros(3), 1.0)
        until(lambda: asked)
        for live in (other, first):
            screen.show(live, np.zeros(3), 1.0)
        hold.set()
        assert all(timed.acquire(timeout=60) for _ in range(3))
        assert (screen.sends_pictures, browser.drawn.visible) == (True, False)
        assert len(asked) == 1 + 2 * PROBE_COUNT  # a picture for each timing at once would hold up the others
    finally:
        screen.close()


def test_a_browser_that_leaves_while_it_is_timed_is_sent_nothing_more(shown_in, monkeypatch):
    from og_pointcloud.show.screen import Screen

    left = []

    def leave(screen, node, probe=Screen._probe):
        seconds = probe(screen, node)
        if not node.visible:
            screen.close()
            left.append(screen)
            raise RuntimeError("it left")
        return seconds

    monkeypatch.setattr(Screen, "_probe", leave)
    _live, browser, screen = shown_in(0.9, 0.1)
    assert left == [screen]
    assert (screen.sends_pictures, browser.drawn.visible) == (False, False)
    asked, browser.get_render = [], lambda *_, **__: asked.append(True)
    screen._time(browser.drawn)  # of another scene, which waited
    assert not asked


def test_a_picture_that_comes_late_is_in_the_colors_of_now(shown_in):
    live, browser, screen = shown_in(0.9, 0.1)
    until(lambda: browser.pictures)
    until(lambda: browser.background is not None)
    late = screen._background_timer
    live.ask("plum")
    screen.paint(live.colors())
    late.function(*late.args)  # it had fired, and waited for its turn
    assert np.array_equal(browser.background, screen.picture())


@pytest.mark.slow
@pytest.mark.parametrize("sent", ["points", "pictures"])
def test_a_browser_types_a_word_sees_the_points_lit_and_clicks_them(pages, window, monkeypatch, sent):
    monkeypatch.setattr("og_pointcloud.show.screen.SLOW_BROWSER_S", np.inf if sent == "points" else -np.inf)
    # Two plates, one above the other in the picture, each an instance of its own and of one color.
    plate = np.stack(np.meshgrid(np.arange(0, 2, 0.02), np.arange(0, 0.9, 0.02)), axis=-1).reshape(-1, 2)
    xyz = np.concatenate([np.c_[plate, np.zeros(len(plate))], np.c_[plate + np.array([0, 1.1]), np.zeros(len(plate))]])
    cloud = make_cloud(xyz, np.repeat([0, 1], len(plate)), spacing=0.02, reach=0.06, words=("left", "right"))
    live = LiveScene(og.LabelledScene.from_cloud(replace(cloud, rgb=np.full((len(xyz), 3), 200, np.uint8))))
    color = {name: live.colors()[live.ids == k][0].astype(int) for k, name in enumerate(("left", "right"))}
    assert len({tuple(value) for value in color.values()}) == 2
    served = pages.serve({"plates": live}, pages.ServeSettings(port=0))
    try:
        window.goto(served.url)
        shown = {
            name: lambda name=name: np.abs(picture_of(window.screenshot()) - color[name]).max(axis=2) <= 3
            for name in color
        }
        until(lambda: shown["left"]().sum() > 2000 and shown["right"]().sum() > 2000, 90)
        until(lambda: [screen.sends_pictures for screen in served._screens.values()] == [sent == "pictures"])
        places = {name: np.argwhere(shown[name]()[:, :450]).mean(axis=0) for name in color}

        window.locator("form input").fill("right")
        until(lambda: shown["left"]().sum() < 50)
        assert shown["right"]().sum() > 2000
        assert live.lit == {1}
        assert "fits 1 of 2 instances" in window.inner_text("body")

        row, column = places["left"]
        window.mouse.click(column, row)
        until(lambda: live.lit == {0})
        until(lambda: "instance 0 ·" in window.inner_text("body"))
        until(lambda: shown["right"]().sum() < 50)
        assert shown["left"]().sum() > 2000

        window.locator("form input").fill("lef")
        window.keyboard.press("Enter")
        until(lambda: "did you mean" in window.inner_text("body"))
        until(lambda: shown["right"]().sum() > 2000)
        with window.expect_download() as download:
            window.get_by_role("button", name="picture").click()
        saved = picture_of(download.value.path().read_bytes())
        assert (np.abs(saved - color["left"]).max(axis=2) <= 20).sum() > 2000
    finally:
        served.stop()


@pytest.fixture(scope="module")
def visits_of_a_place():
    """The chest stays, the bin leaves, a parcel comes, the crate moves."""
    import visits

    things = [visits.CHEST, visits.BIN, visits.CRATE]
    later = [visits.CHEST, visits.moved(visits.CRATE, (-0.9, 0.3, 0)), visits.PARCEL]
    before, after = (og.fit(visits.scene(place, seed=k), progress=False) for k, place in enumerate((things, later)))
    return before, after, og.compare(before, after)


def test_two_visits_are_colored_by_what_became_of_things(visits_of_a_place):
    import visits

    before, after, changes = visits_of_a_place
    both, change = both_visits(before, after, changes)
    live = LiveScene(og.LabelledScene.from_cloud(both), changes=change)
    assert (live.mode, "changes" in live.modes) == ("changes", True)
    seen = {name: points for name, _, points in live.legend()}
    assert set(seen) == {"gone", "new", "moved from here", "moved to here", "as it was"}
    gone = visits.instance_of(before, visits.BIN)
    assert seen["gone"] == (before.instance_ids == gone).sum()
    assert seen["new"] == (after.instance_ids == visits.instance_of(after, visits.PARCEL)).sum()
    colors, shown = live.colors(), live.ids == len(after.instances) + gone
    hue = np.array(CHANGES["gone"]) / max(CHANGES["gone"])
    assert np.abs(colors[shown] / colors[shown].max(axis=1, keepdims=True) - hue).max() < 0.02
    same, nothing = both_visits(after, after, og.Changes((), (), (), ()))
    assert len(same) == len(after)
    assert set(nothing) == {[*CHANGES].index("as it was")}


def test_two_visits_are_served_by_one_command(visits_of_a_place, tmp_path, pages, capsys, monkeypatch):
    before, after, _ = visits_of_a_place
    monday, friday = (str(write_bundle(cloud, tmp_path / f"{day}.ogpc")) for day, cloud in
                      (("monday", before), ("friday", after)))  # fmt: skip
    monkeypatch.setattr("og_pointcloud.show.serve.LivePage.wait", lambda page: page.stop())
    main(["serve", friday, "--before", monday, "--port", "0"])
    assert "since monday: 1 gone, 1 new, 1 moved, 0 not seen again" in capsys.readouterr().out
    for more, says in (([friday], "--before is for one scene"), (["--cloud", "c.ply"], "expected one")):
        assert says in error_of(capsys, "serve", friday, *more, "--before", monday)


def test_the_page_of_changes_calls_nothing_unknown_that_is_as_it_was(visits_of_a_place, tmp_path):
    before, after, changes = visits_of_a_place
    write_changes_page(tmp_path / "changes.html", before, after, changes, np.array([0.0, 0, 1]))
    data = content(tmp_path / "changes.html")
    both, change = both_visits(before, after, changes)
    still = np.isin(both.instance_ids, np.flatnonzero(change < 4), invert=True)
    assert (data["unlabelled"], data["unknown"]) == ("as it was, or not seen again", still.sum())


def test_a_page_of_one_thing_beside_a_point_that_no_view_sees(tmp_path):
    one = make_cloud(np.eye(3), [0, 0, og.UNOBSERVED])
    nothing = make_cloud(np.eye(3), [-1, -1, -1])
    write_changes_page(tmp_path / "c.html", nothing, one, og.Changes((), (0,), (), ()), np.array([0.0, 0, 1]))
    assert "1 new" in (tmp_path / "c.html").read_text()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["serve", "page"])
def test_a_browser_shows_what_is_gone_and_new(visits_of_a_place, tmp_path, window, kind):
    before, after, changes = visits_of_a_place
    served = None
    if kind == "serve":
        serve = pytest.importorskip("og_pointcloud.show.serve")
        both, change = both_visits(before, after, changes)
        live = LiveScene(og.LabelledScene.from_cloud(both), changes=change)
        served = serve.serve({"visits": live}, serve.ServeSettings(port=0))
        url = served.url
    else:
        write_changes_page(tmp_path / "changes.html", before, after, changes, np.array([0.0, 0, 1]))
        url = (tmp_path / "changes.html").as_uri()
    try:
        window.goto(url)

        def pixels(name):
            """Of the hue of a state, however light or dark."""
            picture = picture_of(window.screenshot())[:, :500] if served else picture_of(window.screenshot())[:, 310:]
            hue, value = np.array(CHANGES[name]) / max(CHANGES[name]), picture.max(axis=2, keepdims=True)
            return ((np.abs(picture / np.maximum(value, 1) - hue).max(axis=2) < 0.04) & (value[..., 0] > 60)).sum()

        states = ("gone", "new", "moved from here", "moved to here")
        until(lambda: all(pixels(name) > 150 for name in states), 90)
        assert all(name in window.inner_text("body") for name in states)
    finally:
        if served is not None:
            served.stop()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["points", "splats"])
def test_three_js_draws_a_labelled_gltf(pages, tmp_path, window, kind):
    """In the page of viser, whose loader of glTF is that of three.js: it knows no splats, and draws their points."""
    from test_carriers import segmentation
    from test_formats_spz import splats

    points = replace(splats(20_000, center=(3, -4, 5)), opacity=np.ones(20_000, np.float32))
    result = segmentation(np.arange(20_000) % 3, ["a", "b", "c"], points.xyz_world)
    path = result.save(tmp_path / "out.glb", points if kind == "splats" else None)
    server = pages.viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    try:
        server.scene.add_glb("/labelled", path.read_bytes())
        server.initial_camera.position, server.initial_camera.look_at = (3, -4, 11), (3, -4, 5)
        window.goto(f"http://127.0.0.1:{server.get_port()}")

        def pixels(color):
            """Of a label's color, as far as a point covers them on the white page, beside its panels."""
            cover = 255 - picture_of(window.screenshot())[200:, :500]
            most, hue = cover.max(axis=2, keepdims=True), (255 - color.astype(int)) / (255 - color).max()
            return ((np.abs(cover / np.maximum(most, 1) - hue).max(axis=2) < 0.2) & (most[..., 0] > 60)).sum()

        until(lambda: all(pixels(color) > 100 for color in np.unique(result.colors, axis=0)), 90)
    finally:
        server.stop()
