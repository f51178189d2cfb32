"""Runs the back-end beside the front-end, so that a loop search never stalls the pose output.

A keyframe's result takes effect at a sensor time: the keyframe's plus the latency. Replay computes synchronously,
the daemon in a thread; both give the same poses as long as the thread is never later than the latency. Results that
are late take effect when they are ready, and their lateness is counted.
"""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections import deque
from typing import Protocol

from robominer_slam.slam.keyframe import Backend, BackendResult, Keyframe, ReleasesMemory

log = logging.getLogger(__name__)


class BackendRunner(Protocol):
    """Takes keyframes, gives results when they take effect.

    Attributes:
        late: results that were not ready when due.
        max_late_ns: by how much at the most, in sensor time.
        behind_ns: by how much the result that is due next is late now.
        busy_s: time the back-end has computed, s.
    """

    late: int
    max_late_ns: int
    behind_ns: int
    busy_s: float

    def submit(self, keyframe: Keyframe) -> None:
        """Hand a keyframe to the back-end."""
        ...

    def due(self, stamp_ns: int) -> list[BackendResult]:
        """Results that take effect at or before this sensor time, in order."""
        ...

    def close(self) -> list[BackendResult]:
        """Finish what was submitted and return all results that have not been handed out."""
        ...


class SynchronousRunner:
    """Computes at once, for replay: the same recording gives the same result."""

    def __init__(self, backend: Backend, latency_ns: int) -> None:
        self._backend = backend
        self._latency_ns = latency_ns
        self._results: deque[BackendResult] = deque()
        self.late = 0
        self.max_late_ns = 0
        self.behind_ns = 0
        self.busy_s = 0.0

    def submit(self, keyframe: Keyframe) -> None:
        """Hand a keyframe to the back-end."""
        start = time.perf_counter()
        self._results.append(self._backend.process(keyframe))
        self.busy_s += time.perf_counter() - start

    def due(self, stamp_ns: int) -> list[BackendResult]:
        """Results that take effect at or before this sensor time, in order."""
        due = []
        while self._results and self._results[0].keyframe.stamp_ns + self._latency_ns <= stamp_ns:
            due.append(self._results.popleft())
        return due

    def close(self) -> list[BackendResult]:
        """All results that have not been handed out."""
        rest = list(self._results)
        self._results.clear()
        return rest


class ThreadedRunner:
    """The thread `backend`: small_gicp and SuperLU release the interpreter lock while they work.

    Args:
        backend: used by this thread only.
        latency_ns: see the module.
        queue_length: keyframes that may wait; a full queue makes `submit` wait, since no keyframe may be lost.
    """

    def __init__(self, backend: Backend, latency_ns: int, queue_length: int) -> None:
        self._backend = backend
        self._latency_ns = latency_ns
        self._jobs: queue.Queue[Keyframe | None] = queue.Queue(queue_length)
        self._results: deque[BackendResult] = deque()
        self._waiting: deque[int] = deque()
        self._counted_late: int | None = None
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="backend", daemon=True)
        self._thread.start()
        self.late = 0
        self.max_late_ns = 0
        self.behind_ns = 0
        self.busy_s = 0.0

    def submit(self, keyframe: Keyframe) -> None:
        """Hand a keyframe to the back-end.

        Raises:
            RuntimeError: the thread has failed.
        """
        self._waiting.append(keyframe.stamp_ns)
        while True:
            self._check()
            try:
                self._jobs.put(keyframe, timeout=0.5)
                return
            except queue.Full:
                continue

    def due(self, stamp_ns: int) -> list[BackendResult]:
        """Results that take effect at or before this sensor time, in order."""
        self._check()
        self.behind_ns = 0
        due = []
        while self._waiting and self._waiting[0] + self._latency_ns <= stamp_ns:
            late_ns = stamp_ns - self._waiting[0] - self._latency_ns
            if not self._results:
                if self._counted_late != self._waiting[0]:
                    self._counted_late = self._waiting[0]
                    self.late += 1
                self.max_late_ns = max(self.max_late_ns, late_ns)
                self.behind_ns = late_ns
                break
            self._waiting.popleft()
            due.append(self._results.popleft())
        return due

    def close(self) -> list[BackendResult]:
        """Finish what was submitted and return all results that have not been handed out."""
        while self._thread.is_alive():
            try:
                self._jobs.put(None, timeout=0.5)
                break
            except queue.Full:
                continue
        self._thread.join()
        self._check()
        rest = list(self._results)
        self._results.clear()
        self._waiting.clear()
        return rest

    def _check(self) -> None:
        if self._failure is not None:
            raise RuntimeError("the back-end failed") from self._failure

    def _run(self) -> None:
        try:
            while (keyframe := self._jobs.get()) is not None:
                start = time.perf_counter()
                self._results.append(self._backend.process(keyframe))
                self.busy_s += time.perf_counter() - start
        except BaseException as error:
            # Raised in the front-end's thread at its next call: a thread must not die unseen.
            self._failure = error
            log.exception("the back-end failed")
        finally:
            if isinstance(self._backend, ReleasesMemory):
                self._backend.release()
