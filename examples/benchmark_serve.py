"""How long a typed word takes to light its points on the live page of `og-pointcloud serve`.

    python examples/benchmark_serve.py SCENE.ogpc                   # at 300,000 points
    python examples/benchmark_serve.py SCENE.ogpc --points 1000000

The cloud shown is points of the scene's own, moved by noise. answer: the word is looked up, instances are chosen and
points colored, in Python: on the clock, and of one core. told: from the key to the answer beside the picture,
which no frame holds up. lit: to the first frame that looks another way; without a GPU nearly all of it is drawing. Both
need playwright and a Chromium.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from benchmark_runtime import make_frame

import og_pointcloud as og
from og_pointcloud.scene import Points
from og_pointcloud.show.live import LiveScene

BROWSER = [
    "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-background-networking",
]  # fmt: skip
WINDOW = {"width": 1100, "height": 700}
KEPT = """
const original = HTMLCanvasElement.prototype.getContext
HTMLCanvasElement.prototype.getContext = function (kind, options) {
  const context = original.call(this, kind, { ...options, preserveDrawingBuffer: true })
  if (kind === "webgl2") window.pen = context
  return context }
window.draws = 0
for (const name of ["drawArrays", "drawElements"]) {
  const draw = WebGL2RenderingContext.prototype[name]
  WebGL2RenderingContext.prototype[name] = function (...values) { window.draws += 1; draw.apply(this, values) } }
"""
"""What is drawn can be read at any time, and draws are counted."""
WATCH = """
() => {
  const box = document.querySelector("form input"), pen = window.pen
  const row = new Uint8Array(4 * pen.drawingBufferWidth)
  const seen = () => {
    pen.readPixels(0, pen.drawingBufferHeight >> 1, pen.drawingBufferWidth, 1, pen.RGBA, pen.UNSIGNED_BYTE, row)
    return row.join() }
  const before = seen()
  window.lit = window.told = 0
  box.addEventListener("input", () => {
    const start = performance.now(), since = () => performance.now() - start
    const changed = { childList: true, characterData: true, subtree: true }
    new MutationObserver((_, observer) => {
      if (![...document.querySelectorAll("b")].some((title) => title.textContent === box.value)) return
      window.told = since()
      observer.disconnect()
    }).observe(document.body, changed)
    let drawn = window.draws
    const look = () => {
      // To read waits for the frame: only where there is a new one, and the answer was not held up by it.
      if (window.told && window.draws !== drawn) { drawn = window.draws; if (seen() !== before) window.lit = since() }
      if (!window.lit) requestAnimationFrame(look) }
    requestAnimationFrame(look)
  }, { once: true })
}"""


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
    live.ask(words[0])  # what is made once
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
    """Median and largest."""
    print(
        f"{name:<18} median {1e3 * float(np.median(seconds)):7.1f} ms   largest {1e3 * max(seconds):7.1f} ms",
        flush=True,
    )


def answer_seconds(live: LiveScene, word: str) -> tuple[float, float]:
    """From a word to the colors of all points: on the clock, and computing."""
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
        page.add_init_script(KEPT)
        page.goto(served.url)
        page.wait_for_selector("form input", timeout=60_000)
        time.sleep(8)
        yield page
    finally:
        browser.close()
        served.stop()


def browser_seconds(page: Any, word: str) -> tuple[float, float]:
    """From the key to the answer, and to another picture. Everything is lit before."""
    page.locator("form input").fill("")
    time.sleep(3)
    page.evaluate(WATCH)
    page.locator("form input").fill(word)
    page.wait_for_function("window.lit && window.told", timeout=60_000)
    return page.evaluate("window.told") / 1e3, page.evaluate("window.lit") / 1e3


if __name__ == "__main__":
    main()
