"""Queries on a Zenoh session: to wait for the answers, or to be called back with them."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping

import zenoh

from robominer_slam.publishing.bus_messages import QueryError
from robominer_slam.publishing.keys import Qos

log = logging.getLogger(__name__)


def selector(key: str, parameters: Mapping[str, str]) -> str:
    """A key in full with its parameters, whose values must not contain `;`."""
    text = ";".join(f"{name}={value}" for name, value in parameters.items())
    return key + (f"?{text}" if text else "")


def answered(session: zenoh.Session, key: str, timeout_s: float) -> bool:
    """Whether somebody answers queries of a key, and shows it to us; nothing is asked."""
    known = threading.Event()
    with session.declare_querier(key) as querier:
        listener = querier.declare_matching_listener(lambda status: known.set() if status.matching else None)
        # Zenoh's stubs leave this method without a return type.
        end_listening: Callable[[], None] = listener.undeclare
        found = bool(getattr(querier.matching_status, "matching", False)) or known.wait(timeout_s)
        end_listening()
    return found


def wait(
    session: zenoh.Session,
    asked: str,
    qos: Qos,
    timeout_s: float,
    payload: bytes | None = None,
    source: zenoh.SourceInfo | None = None,
) -> list[zenoh.Sample]:
    """All answers.

    Raises:
        QueryError: nobody answered in time, or with errors only.
    """
    # Several answers on one key are parts of one answer, not versions of it: keep all.
    replies = session.get(
        asked,
        consolidation=zenoh.ConsolidationMode.NONE,
        timeout=timeout_s,
        payload=payload,
        priority=qos.priority,
        congestion_control=qos.congestion,
        source_info=source,
    )
    samples: list[zenoh.Sample] = []
    errors: list[str] = []
    for reply in replies:
        if reply.ok is not None:
            samples.append(reply.ok)
        elif reply.err is not None:
            errors.append(_text(reply.err))
    if samples:
        return samples
    reason = "; ".join(errors) or "no answer; is the robot's program running?"
    raise QueryError(f"{asked.partition('?')[0]}: {reason}")


def start(
    session: zenoh.Session,
    asked: str,
    qos: Qos,
    timeout_s: float,
    on_sample: Callable[[zenoh.Sample], None],
    on_end: Callable[[], None],
) -> None:
    """Ask, and do not wait; both are called in a thread of Zenoh's, `on_end` last and whatever happened."""

    def take(reply: zenoh.Reply) -> None:
        try:
            if reply.ok is not None:
                on_sample(reply.ok)
            elif reply.err is not None:
                # Zenoh's own time-out comes as an error, too, and is common on a link that breaks.
                log.info("%s: no answer: %s", asked, _text(reply.err))
        # Whatever it is must not end Zenoh's thread, and must be seen.
        except Exception:
            log.exception("an answer to %s could not be taken", asked)

    def end() -> None:
        try:
            on_end()
        except Exception:
            log.exception("the end of the answers to %s could not be taken", asked)

    session.get(
        asked,
        zenoh.handlers.Callback(take, end),
        consolidation=zenoh.ConsolidationMode.NONE,
        timeout=timeout_s,
        priority=qos.priority,
        congestion_control=qos.congestion,
    )


def _text(error: zenoh.ReplyError) -> str:
    return error.payload.to_bytes().decode("utf-8", "replace")
