"""The daemon in role `drivers`: this board's devices onto the network, for a board that does the SLAM."""

from __future__ import annotations

import logging
import threading
import time

from robominer_slam import status_report
from robominer_slam.publishing import report_messages
from robominer_slam.publishing.zenoh_session import ZenohBus
from robominer_slam.remote_status import RemoteStatus, short_status
from robominer_slam.sources.source import MeasurementSource
from robominer_slam.sources.zenoh_source import publish_raw
from robominer_slam.status_words import StatusWords, device_words
from robominer_slam.supervision import Progress, Supervision
from robominer_slam.wall_clock import WallClock

log = logging.getLogger(__name__)

STATUS_INTERVAL_S = 1.0
WAIT_S = 0.1


def forward(source: MeasurementSource, bus: ZenohBus, stop: threading.Event, supervision: Supervision) -> None:
    """Publish every measurement on `raw/<device>` and the devices' state on `status`, until `stop` is set."""
    clock = WallClock()
    remote_status = RemoteStatus()
    forwarded = 0
    next_status = time.monotonic()
    while not stop.is_set():
        item = source.get(WAIT_S)
        if item is not None:
            publish_raw(bus, clock, *item)
            forwarded += 1
        if time.monotonic() >= next_status:
            next_status += STATUS_INTERVAL_S
            entries = [status_report.process_diagnostic(clock, source.dropped)]
            devices = source.status()
            entries += [status_report.device_diagnostic(device) for device in devices]
            stamp = clock.now_unix_ns()
            bus.put("status", report_messages.diagnostics(stamp, entries))
            if bus.remote and remote_status.due(time.monotonic_ns(), entries, bus.remote_links()):
                bus.put("status", short_status(stamp, entries), ros=False)
            idle = not any(device.state == "streaming" for device in devices)
            rate = supervision.rate_hz(forwarded)
            state = "forwarding" if forwarded else "waiting for the first measurement"
            words = StatusWords(state, device_words(devices), f"{rate:.0f} measurements a second")
            # What can change live in this role is the log alone, and that has been done.
            supervision.turn(Progress(forwarded, 0, idle), words, lambda _: None)
    supervision.stopping()
    log.info("ended after %d measurements", forwarded)
