"""Frames from a sensor that does not wait: put never blocks; frames that get too old are dropped and reported."""

from __future__ import annotations

import queue
import threading
import time
import traceback
import warnings
from collections.abc import Callable
from contextlib import suppress
from copy import deepcopy

from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.mapping.frame import Frame, in_arrays
from og_pointcloud.mapping.mapper import FrameChange, Mapper


class FrameQueue:
    """Feeds a mapper in its own thread, in order of arrival.

    max_age: seconds that a frame may wait. on_change: called in that thread with each frame's change. on_drop: called
    with a message for each frame that was dropped, because of its age, because it was refused or came after `close`,
    and if on_change fails; None: a warning. lock: held while a frame is integrated; hold it to use or replace the
    mapper.
    """

    def __init__(
        self,
        mapper: Mapper,
        *,
        max_age: float = 2.0,
        on_change: Callable[[FrameChange], None] | None = None,
        on_drop: Callable[[str], None] | None = None,
    ) -> None:
        self.mapper, self.max_age, self.dropped = mapper, max_age, 0
        self._on_change, self._on_drop = on_change or (lambda change: None), on_drop or warnings.warn
        self._waiting: queue.SimpleQueue[tuple[float, Frame] | None] = queue.SimpleQueue()
        self.lock, self._gate, self._closed = threading.Lock(), threading.Lock(), False
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def put(self, frame: Frame) -> None:
        """Hand a frame over; returns at once. It is copied: a driver may write into its arrays again."""
        with suppress(Exception):  # anything but a frame of arrays is refused, and reported, in its turn
            frame = deepcopy(in_arrays(frame))
        with self._gate:  # never held for long
            if not (closed := self._closed):
                self._waiting.put((time.monotonic(), frame))
        if closed:
            self._drop("a frame came after the queue was closed")

    def close(self) -> None:
        """Process the waiting frames that are not too old, and end the thread."""
        with self._gate:
            self._closed = True
            self._waiting.put(None)
        self._thread.join()

    def _work(self) -> None:
        while (waiting := self._waiting.get()) is not None:  # None: `close` asks for the end
            try:
                self._take(*waiting)
            except Exception:  # of on_drop: there is nobody left to report to, and the thread lives on
                traceback.print_exc()

    def _take(self, arrived: float, frame: Frame) -> None:
        if time.monotonic() - arrived > self.max_age:
            self._drop(f"a frame waited longer than {self.max_age} s")
            return
        change = None
        try:
            with self.lock:
                change = self.mapper.integrate(frame)
                self._on_change(change)
        except Exception as error:  # the thread lives on, and the next frame goes in
            if change is None and isinstance(error, OgPointcloudError):
                self._on_drop(f"a frame was refused: {error}")
            else:
                what = "a frame failed" if change is None else "a frame was added, but on_change failed"
                self._on_drop(f"{what}: {type(error).__name__}: {error}")

    def _drop(self, why: str) -> None:
        self.dropped += 1
        self._on_drop(f"{why}: {self.dropped} dropped so far")
