"""How long a typed word takes to highlight its points on the live page of `og-pointcloud serve`.

    python examples/benchmark_serve.py SCENE.ogpc                   # at 300,000 points
    python examples/benchmark_serve.py SCENE.ogpc --points 1000000

The cloud shown is points of the scene's own, moved by noise. answer: the word is looked up, instances are chosen and
points colored, in Python: wall clock, and processor time of one core. told: from the key press to the answer in the
panel, which comes with the picture where the browser draws slowly. lit: to the first frame of the browser's screencast
that looks different. Both need playwright and a Chromium.
"""

from __future__ import annotations

import argparse
import base64
import shutil
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import imageio.v3
import numpy as np
from benchmark_runtime import make_frame
from numpy.typing import NDArray

import og_pointcloud as og
from og_pointcloud.scene import Points
from og_pointcloud.show.live import LiveScene

BROWSER = [
    "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-background-networking",
]  # fmt: skip
WINDOW = {"width": 1100, "height": 700}
WATCHED_MS = 2000
WATCH = """
() => {
  const box = document.querySelector("form input"), now = () => performance.timeOrigin + performance.now()
  window.told = 0
  box.addEventListener("input", () => {
    window.start = now()
    const changed = { childList: true, characterData: true, subtree: true }
    new MutationObserver((_, observer) => {
      if (![...document.querySelectorAll("b")].some((title) => title.textContent === box.value)) return
      window.told = now()
      observer.disconnect()
    }).observe(document.body, changed)
  }, { once: true })
}"""
"""Records when a key was pressed and when its answer appeared, in milliseconds since 1970."""
LOOKED_AT = 0.5
"""Share of the window's width, from the left, that shows the points, without the panel."""
ANOTHER = 4.0
"""Mean difference of pixel values, 0 to 255, from which a frame looks different: more than JPEG's error."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Parse, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--points", type=int, default=300_000)
    parser.add_argument("--rounds", type=int, default=9)
    options = parser.parse_args(arguments)
    scene = og.load(options.scene)
    random = np.random.default_rng(0)
    own = random.integers(0, len(scene.cloud), options.points)
    colors = None if scene.cloud.rgb is None else scene.cloud.rgb[own]
    live = LiveScene(scene, Points.from_world(make_frame(scene.cloud, options.points, 0.3), rgb=colors))
    words = [name for name in live.names if og.select(scene, name).instances]
    if not words:
        raise SystemExit(
            f"{options.scene} stores no word that fits an instance; add some with og-pointcloud vocabulary"
        )
    words = (words * options.rounds)[: options.rounds]
    print(f"{options.points:,} points, {len(scene.cloud.instances)} instances, {len(live.names)} words")
    live.ask(words[0])  # one-time work
    live.colors()
    both = [answer_seconds(live, word) for word in words]
    print_row("answer", [clock for clock, _ in both])
    print_row("answer, of a core", [core for _, core in both])
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None or find_spec("playwright") is None:
        print("no Chromium or no playwright: the browser's part is not measured", file=sys.stderr)
        return
    from playwright.sync_api import sync_playwright  # pyright: ignore[reportMissingImports]

    with sync_playwright() as playwright, opened(playwright.chromium, browser, live) as page:
        both = [browser_seconds(page, word) for word in words]
        print_row("told", [told for told, _ in both])
        print_row("lit", [lit for _, lit in both])


def print_row(name: str, seconds: Sequence[float]) -> None:
    """Print median and maximum."""
    print(
        f"{name:<18} median {1e3 * float(np.median(seconds)):7.1f} ms   largest {1e3 * max(seconds):7.1f} ms",
        flush=True,
    )


def answer_seconds(live: LiveScene, word: str) -> tuple[float, float]:
    """From a word to the colors of all points: wall clock, and processor time."""
    start, computing = time.perf_counter(), time.process_time()
    live.ask(word)
    live.colors()
    return time.perf_counter() - start, time.process_time() - computing


@contextmanager
def opened(chromium: Any, executable: str, live: LiveScene) -> Iterator[Any]:
    """The live page of a scene in a browser, drawn."""
    from og_pointcloud.show.serve import ServeSettings, serve

    served = serve({"scene": live}, ServeSettings(port=0))
    browser = chromium.launch(executable_path=executable, args=BROWSER)
    try:
        page = browser.new_page(viewport=WINDOW)
        page.goto(served.url)
        page.wait_for_selector("form input", timeout=60_000)
        time.sleep(8)
        yield page
    finally:
        browser.close()
        served.stop()


def browser_seconds(page: Any, word: str) -> tuple[float, float]:
    """From the key press to the answer, and to the first frame that looks different. Everything is lit before."""
    page.locator("form input").fill("")
    page.wait_for_timeout(3000)
    frames = frames_of(page, word)
    start, told = page.evaluate("window.start") / 1e3, page.evaluate("window.told") / 1e3
    before = [picture for second, picture in frames if second < start][-1]
    lit = [second for second, picture in frames if second > start and np.abs(picture - before).mean() > ANOTHER]
    if not lit or not told:
        raise SystemExit(f"'{word}' lit nothing in {WATCHED_MS / 1e3:.0f} s; expected an instance that it fits")
    return told - start, lit[0] - start


def frames_of(page: Any, word: str) -> list[tuple[float, NDArray[np.int16]]]:
    """Type a word: each frame of the browser from a second before on: when it was shown, in seconds since 1970, and
    its pixels beside the panel."""
    frames: list[tuple[float, str]] = []
    cast = page.context.new_cdp_session(page)

    def keep(frame: dict[str, Any]) -> None:
        frames.append((frame["metadata"]["timestamp"], frame["data"]))
        cast.send("Page.screencastFrameAck", {"sessionId": frame["sessionId"]})

    cast.on("Page.screencastFrame", keep)
    cast.send("Page.startScreencast", {"format": "jpeg", "quality": 80, "maxWidth": 550, "maxHeight": 350})
    page.wait_for_timeout(1000)
    page.evaluate(WATCH)
    page.locator("form input").fill(word)
    page.wait_for_timeout(WATCHED_MS)
    cast.remove_listener("Page.screencastFrame", keep)
    cast.send("Page.stopScreencast")
    pictures = [imageio.v3.imread(base64.b64decode(data)).astype(np.int16) for _, data in frames]
    return [
        (second, each[:, : int(LOOKED_AT * each.shape[1])]) for (second, _), each in zip(frames, pictures, strict=True)
    ]


if __name__ == "__main__":
    main()
