"""The daemon: measurements in, poses and map out. The main loop; everything else hangs on it.

Threads: `drivers` (serial ports), this main loop, `backend` (loop search and optimisation), `store` (disk), and
Zenoh's own, which run the answers to queries under the state's lock.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from typing import Literal

from robominer_slam import status_report
from robominer_slam.assembly import build_pipeline, build_slam
from robominer_slam.calibrated_array import CalibratedArray
from robominer_slam.commands import Commands
from robominer_slam.configuration.devices import device_settings
from robominer_slam.configuration.model import Configuration
from robominer_slam.frame_result import FrameResult
from robominer_slam.load_shedding import LoadShedding, Shed
from robominer_slam.map_service import MapService
from robominer_slam.mapping.keyframe_map import KeyframeMap
from robominer_slam.publisher import Publisher
from robominer_slam.publishing import report_messages
from robominer_slam.publishing.bus_messages import Query, Reply
from robominer_slam.publishing.report_messages import Diagnostic
from robominer_slam.publishing.telemetry import Health
from robominer_slam.publishing.zenoh_session import ZenohBus
from robominer_slam.remote_status import RemoteStatus, short_status
from robominer_slam.saved_maps import SavedMaps
from robominer_slam.slam.saved_map import SavedMap
from robominer_slam.sources.source import MeasurementSource
from robominer_slam.status_words import slam_words
from robominer_slam.store import MapStore
from robominer_slam.store_database import StoreError
from robominer_slam.supervision import Progress, Supervision
from robominer_slam.telemetry_frame import telemetry
from robominer_slam.wall_clock import WallClock

log = logging.getLogger(__name__)

STATUS_INTERVAL_NS = 1_000_000_000
TELEMETRY_INTERVAL_NS = 250_000_000
#: What the operator is told where a device sends nothing, by what it carries.
SILENT = {"whiskers": Health.WHISKERS_SILENT, "imu": Health.IMU_SILENT, "screws": Health.SCREWS_SILENT}
#: How long the loop waits for a measurement before it looks whether it should end.
WAIT_S = 0.1


class Daemon:
    """Wires a source of measurements to the pipeline, and the pipeline to bus and store."""

    def __init__(
        self,
        configuration: Configuration,
        array: CalibratedArray,
        source: MeasurementSource,
        bus: ZenohBus,
        store: MapStore,
        supervision: Supervision,
        known: SavedMap | None = None,
        *,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
        execution: Literal["threaded", "synchronous"] = "threaded",
    ) -> None:
        """Take the parts.

        Args:
            configuration: of the robot.
            array: layout and calibration.
            source: of measurements.
            bus: to publish on.
            store: of the map.
            supervision: what systemd is told.
            known: the map to start in.
            monotonic_ns: the clock that measurements are stamped by; a recording's where one is driven through.
            execution: of the back-end: in its own thread, or where the measurements are processed, as in a replay.
        """
        self._monotonic_ns, self._execution = monotonic_ns, execution
        self._configuration = configuration
        self._layout = array.layout
        self._source = source
        self._bus = bus
        self._store = store
        self._supervision = supervision
        self._lock = threading.Lock()
        self._clock = WallClock()
        self._carries = {one.name: one.carries for one in device_settings(configuration)}
        self._pipeline = build_pipeline(configuration, array.layout, array.model, execution, known, store.folder)
        self._map = KeyframeMap(configuration.map.point_voxel)
        self._publisher = Publisher(bus, self._clock, array.layout)
        self._map_service = MapService(bus, self._clock, self._map, configuration.map)
        slam = configuration.slam
        relocalisation = slam.robust.relocalisation if slam.method == "robust" else None
        self._commands = Commands(self._pipeline, self._map, store, self._new_map, relocalisation)
        self._saved_maps = SavedMaps(store.path, lambda: store.map_id, configuration.map.stream_cell)
        self._remote_status = RemoteStatus()
        self._shedding = LoadShedding(configuration.load)
        self._last_frame: FrameResult | None = None
        self._telemetry_ns = self._status_ns = self._telemetry_count = 0
        self._declare_queries()
        if known is not None:
            self._map_service.load(known)
            log.info("map %s with %d keyframes: looking for the place in it", known.name, len(known.keyframes))

    def run(self, stop: threading.Event) -> None:
        """Work until `stop` is set; then finish what was begun and keep it.

        Raises:
            RuntimeError: a thread of ours has failed.
        """
        try:
            while not stop.is_set():
                item = self._source.get(WAIT_S)
                with self._lock:
                    if item is not None:
                        for result in self._pipeline.add(*item):
                            self._frame(result)
                    now = self._monotonic_ns()
                    if now - self._status_ns >= STATUS_INTERVAL_NS:
                        self._status(now)
        finally:
            self._supervision.stopping()
            self._finish()

    def _frame(self, result: FrameResult) -> None:
        for backend_result in result.backend_results:
            self._store.add(backend_result, self._clock.offset_ns)
        sparing = self._shedding.level >= Shed.MAP_DETAIL
        # Poses first: whatever else there is to do can wait for them.
        self._publisher.frame(result, sparing=sparing)
        self._map_service.frame(result, sparing=sparing)
        runner = self._pipeline.runner
        behind_s = 0.0 if runner is None else runner.behind_ns * 1e-9
        self._shedding.frame((self._monotonic_ns() - result.stamp_ns) * 1e-9, behind_s)
        if result.stamp_ns - self._telemetry_ns >= TELEMETRY_INTERVAL_NS:
            self._telemetry_ns = result.stamp_ns
            self._telemetry(result)
        if self._last_frame is None:
            log.info("first whisker frame: publishing poses under %s", self._bus.prefix)
        self._last_frame = result

    def _telemetry(self, result: FrameResult) -> None:
        stamp = self._clock.unix_ns(result.stamp_ns)
        message = telemetry(self._telemetry_count, stamp, result, self._layout, self._map, self._health(result))
        self._telemetry_count += 1
        self._bus.put("telemetry", message)

    def _health(self, result: FrameResult) -> Health:
        health = Health(0)
        if not result.angles.valid[self._layout.present].all():
            health |= Health.WHISKERS_FAULTY
        for device in self._source.status():
            if device.state == "synchronising":
                health |= Health.CLOCK_NOT_SYNCHRONISED
            elif device.state != "streaming":
                health |= SILENT.get(self._carries.get(device.name) or "", Health.FINE)
        if self._store.fault:
            health |= Health.STORE_FAILING
        if self._pipeline.paused:
            health |= Health.PAUSED
        if self._shedding.level >= Shed.LOOP_SEARCH:
            health |= Health.BACKEND_LATE
        if self._source.dropped:
            health |= Health.MEASUREMENTS_DROPPED
        return health

    def _status(self, now: int) -> None:
        self._status_ns = now
        self._pipeline.shed = self._shedding.turn(now * 1e-9)
        stamp = self._clock.unix_ns(now)
        entries = self._diagnostics(now)
        self._bus.put("status", report_messages.diagnostics(stamp, entries))
        # At once: links within the machine tell the short one by that, and drop it (tls_settings.py).
        if self._bus.remote and self._remote_status.due(now, entries, self._bus.remote_links()):
            self._bus.put("status", short_status(stamp, entries), ros=False)
        self._supervise()

    def _supervise(self) -> None:
        frames, devices = self._publisher.frames, self._source.status()
        refused = self._pipeline.wrong_size_frames + self._pipeline.stale_frames + self._pipeline.reorder.dropped
        idle = not any(one.state == "streaming" and self._carries.get(one.name) == "whiskers" for one in devices)
        rate = self._supervision.rate_hz(frames)
        words = slam_words(self._last_frame, rate, len(self._map.keyframes), devices)
        self._supervision.turn(Progress(frames, refused, idle), words, self._apply)

    def _apply(self, configuration: Configuration) -> None:
        self._configuration = configuration
        self._map_service.section = configuration.map
        self._store.sync_s = configuration.store.sync_s

    def _diagnostics(self, now_ns: int) -> list[Diagnostic]:
        frame = self._last_frame
        age_s = (now_ns - frame.stamp_ns) * 1e-9 if frame is not None else 0.0
        entries = [
            status_report.slam_diagnostic(frame, age_s, self._pipeline, self._map, self._map_service.digest),
            status_report.process_diagnostic(self._clock, self._source.dropped),
            status_report.load_diagnostic(self._shedding),
            status_report.store_diagnostic(self._store),
            *(status_report.device_diagnostic(device) for device in self._source.status()),
        ]
        if frame is not None:
            entries.append(status_report.whiskers_diagnostic(frame, self._layout, self._pipeline))
        return entries

    def _finish(self) -> None:
        with self._lock:
            runner = self._pipeline.runner
            if runner is not None:
                for result in runner.close():
                    self._map.take(result)
                    self._store.add(result, self._clock.offset_ns)
        if self._store.flush(10.0):
            try:
                self._store.save_poses(self._map.poses, self._map.ids, self._map.edges)
            except StoreError as error:
                log.error("%s; the next start has those of some seconds ago", error)
        else:
            log.error("ended with keyframes that are not stored: %s", self._store.fault or "the disk is too slow")
        log.info(
            "ended after %d frames: %d keyframes, %d loop closures, %d keyframes stored",
            self._publisher.frames, len(self._map.keyframes), self._map.closures, self._store.written,
        )  # fmt: skip

    def _new_map(self) -> None:
        self._store.new_map(self._configuration.robot.id, "")
        self._pipeline.start_new_map(*build_slam(self._configuration, self._execution, page_folder=self._store.folder))
        self._map_service.new_map()

    def _declare_queries(self) -> None:
        service = self._map_service
        handlers: dict[str, Callable[[Query], list[Reply]]] = {
            "map/snapshot": service.snapshot,
            "map/cloud": lambda _: service.cloud(),
            "map/grid": lambda _: service.grid(),
            "map/graph": lambda _: service.graph(),
            "map/closures": service.closures,
            "cmd/*": self._commands.handle,
        }
        for key, handler in handlers.items():
            self._bus.queryable(key, self._locked(handler))
        self._bus.queryable("map/saved", self._saved_maps.answer)

    def _locked(self, handler: Callable[[Query], list[Reply]]) -> Callable[[Query], list[Reply]]:
        def answer(query: Query) -> list[Reply]:
            with self._lock:
                return handler(query)

        return answer
