"""The operator at the terminal, and the frames that go on coming meanwhile."""

from __future__ import annotations

import queue
import sys
import threading
import time
from collections.abc import Callable
from typing import Protocol

from calibration.capture_labels import CaptureError
from drivers.measurement import HallFrame


class FrameSource(Protocol):
    """Delivers frames; `device.WhiskerDevice` is one."""

    def frame(self, timeout: float) -> HallFrame | None:
        """The next frame, or None after `timeout` seconds."""
        ...


class Operator:
    """Lines that the operator types, without stopping the reading of the device."""

    def __init__(self) -> None:
        self._lines: queue.Queue[str | None] = queue.Queue()
        self._thread = threading.Thread(target=self._read, name="operator", daemon=True)

    def start(self) -> None:
        """Begin to read standard input."""
        if not self._thread.is_alive():
            self._thread.start()

    def _read(self) -> None:
        for line in sys.stdin:
            self._lines.put(line.strip())
        self._lines.put(None)

    def answer(self) -> str | None:
        """The next line, or None if nothing was typed yet.

        Raises:
            CaptureError: the input has ended.
        """
        try:
            line = self._lines.get_nowait()
        except queue.Empty:
            return None
        if line is None:
            raise CaptureError("the input ended before the last step; for unattended use give --auto or --script")
        return line

    def wait(self, source: FrameSource, seconds: float | None, on_frame: Callable[[HallFrame], None]) -> bool:
        """Wait for Enter, or for some seconds, while frames are shown; False where the operator leaves it out.

        Raises:
            CaptureError: the input has ended, or the source has failed.
        """
        if seconds is None:
            self.start()
        end = None if seconds is None else time.monotonic() + seconds
        while end is None or time.monotonic() < end:
            frame = source.frame(0.02)
            if frame is not None:
                on_frame(frame)
            answer = self.answer() if seconds is None else None
            if answer is not None:
                return answer.lower() not in ("s", "skip")
        return True
