"""Frames from a sensor that waits for nobody: put never blocks, and what gets too old is dropped, and said to be."""

from __future__ import annotations

import threading
import time
import warnings
from collections import deque
from collections.abc import Callable

from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.mapping.frame import Frame
from og_pointcloud.mapping.mapper import FrameChange, Mapper

__all__ = ["FrameQueue"]


class FrameQueue:
    """Feeds a mapper in a thread of its own, in the order in which frames come.

    max_age: seconds that a frame may wait. on_change: called, in that thread, with each frame's change. on_drop: called
    with what is said of a frame that was dropped, for its age or because it was refused; None: a warning.
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
        self._on_change, self._on_drop = on_change, on_drop or warnings.warn
        self._waiting: deque[tuple[float, Frame]] = deque()
        self._wake, self._open = threading.Condition(), True
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def put(self, frame: Frame) -> None:
        """Hand a frame over; returns at once."""
        with self._wake:
            self._waiting.append((time.monotonic(), frame))
            self._wake.notify()

    def close(self) -> None:
        """Work off what waits and is young enough, and end the thread."""
        with self._wake:
            self._open = False
            self._wake.notify()
        self._thread.join()

    def _next(self) -> Frame | None:
        """The oldest frame that is young enough; None when closed and empty."""
        with self._wake:
            while True:
                while self._waiting:
                    arrived, frame = self._waiting.popleft()
                    if time.monotonic() - arrived <= self.max_age:
                        return frame
                    self.dropped += 1
                    self._on_drop(f"a frame waited longer than {self.max_age} s: {self.dropped} dropped so far")
                if not self._open:
                    return None
                self._wake.wait()

    def _work(self) -> None:
        while (frame := self._next()) is not None:
            try:
                change = self.mapper.integrate(frame)
            except OgPointcloudError as error:
                self._on_drop(f"a frame was refused: {error}")
            else:
                if self._on_change:
                    self._on_change(change)
