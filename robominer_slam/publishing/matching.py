"""Whether anybody subscribes to what a publisher sends."""

from __future__ import annotations

import zenoh
from zenoh import ext


def somebody_listens(publisher: zenoh.Publisher | ext.AdvancedPublisher, *, unknown: bool) -> bool:
    """Whether there is a subscriber; `unknown` where the publisher cannot tell, as those with a history."""
    if not isinstance(publisher, zenoh.Publisher):
        return unknown
    # Zenoh's stubs declare the status as a plain bool.
    status: object = publisher.matching_status
    return bool(getattr(status, "matching", status))
