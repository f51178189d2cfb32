"""The bus: a Zenoh session with the robot's keys, to publish, answer queries, subscribe and ask."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable, Mapping
from functools import lru_cache
from types import TracebackType
from typing import TypeAlias

import zenoh
from zenoh import ext

from robominer_slam.publishing import asking
from robominer_slam.publishing.bus_messages import Query, QueryError, QueryRefusedError, Received, Reply, parameters_of
from robominer_slam.publishing.keys import Qos, encoding_of, qos_of, qos_of_query
from robominer_slam.publishing.publishers import Publisher, declare, somebody_listens
from robominer_slam.publishing.ros_bridge import open_bridge
from robominer_slam.publishing.senders import Peer, own_source, sender
from robominer_slam.publishing.zenoh_settings import ZenohSettings, ZenohSetupError, open_session

__all__ = [
    "Query",
    "QueryError",
    "QueryRefusedError",
    "Received",
    "Reply",
    "ZenohBus",
    "ZenohSettings",
    "ZenohSetupError",
]

log = logging.getLogger(__name__)

DEFAULT_TIMEOUT_S = 5.0

#: Encodings from their names, each read once.
_encoding = lru_cache(maxsize=64)(zenoh.Encoding)

_Declared: TypeAlias = "zenoh.Subscriber[None] | ext.AdvancedSubscriber[None] | zenoh.Queryable[None]"


class ZenohBus:
    """A session and what is declared on it; use it with `with`. Safe to use from several threads.

    Keys are relative to the prefix. Callbacks run in threads of Zenoh's; what they raise is logged.

    Attributes:
        prefix: `robominer/<robot id>`.
        remote: whether there may be TLS links.
    """

    def __init__(self, settings: ZenohSettings, prefix: str) -> None:
        """Open the session.

        Args:
            settings: how to join the network.
            prefix: `robominer/<robot id>`.

        Raises:
            ZenohSetupError: an endpoint that cannot be listened on or connected to.
        """
        self.prefix = prefix.strip("/")
        self.remote = settings.remote
        self._commanders = settings.commanders
        self._session = open_session(settings)
        self._lock = threading.Lock()
        self._publishers: dict[str, Publisher] = {}
        self._latched: dict[str, Reply] = {}
        self._declared: list[_Declared] = []
        self._ros = open_bridge(self._session, settings.ros, self.prefix)

    def __enter__(self) -> ZenohBus:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Take everything back and leave the network; again is harmless."""
        with self._lock:
            declared, self._declared = self._declared, []
            publishers, self._publishers = list(self._publishers.values()), {}
        if self._session.is_closed():
            return
        if self._ros is not None:
            self._ros.close()
        # Zenoh's stubs leave these methods without a return type.
        leave: list[Callable[[], None]] = [entity.undeclare for entity in (*declared, *publishers)]
        leave.append(self._session.close)
        for step in leave:
            step()

    def links(self) -> int:
        """Number of others that this session is connected to."""
        return len(list(self._session.info.transports()))

    def remote_links(self) -> frozenset[str]:
        """Others that are connected by TLS, by their Zenoh id."""
        return frozenset(str(link.zid) for link in self._session.info.links() if link.auth_identifier is not None)

    def answered(self, key: str, timeout_s: float) -> bool:
        """Whether somebody answers queries of a key, and shows it to us; nothing is asked."""
        return asking.answered(self._session, self._full(key), timeout_s)

    def put(
        self,
        key: str,
        payload: bytes,
        encoding: str | None = None,
        *,
        qos: Qos | None = None,
        attachment: bytes | None = None,
        ros: bool = True,
    ) -> None:
        """Publish.

        Args:
            key: under the prefix.
            payload: the bytes.
            encoding: by default that of the key (`keys.encoding_of`); `keys.cdr(type)` for `raw/<device>`.
            qos: how it travels, by default as `keys.qos_of` says; that of a key's first message holds.
            attachment: small bytes that travel beside the payload.
            ros: whether it goes to ROS, too, where that is set up.
        """
        chosen = encoding_of(key) if encoding is None else encoding
        self._publisher(key, qos).put(payload, encoding=_encoding(chosen), attachment=attachment)
        if self._ros is not None and ros:
            self._ros.put(key, payload)

    def wanted(self, key: str) -> bool:
        """False if nobody subscribes to the key, so that its message need not be made at all."""
        if self._ros is not None and self._ros.wanted(key):
            return True
        return somebody_listens(self._publisher(key, None), unknown=True)

    def latch(self, key: str, payload: bytes, encoding: str | None = None) -> None:
        """Publish, and keep it for those who come later: by their history, or by a query of the key."""
        reply = Reply(payload, encoding_of(key) if encoding is None else encoding)
        with self._lock:
            first = key not in self._latched
            self._latched[key] = reply
        self.put(key, payload, reply.encoding, qos=qos_of(key)._replace(cache=1))
        if first:
            self.queryable(key, lambda _: self._latched[key])

    def subscriber(self, key: str, callback: Callable[[Received], None], *, history: bool = False) -> None:
        """Call back with every message.

        Args:
            key: under the prefix; may have wildcards.
            callback: runs in one thread of its own, message after message.
            history: also get what publishers with a cache sent before, and again what was lost on the way.
        """

        def on_sample(sample: zenoh.Sample) -> None:
            try:
                callback(self._received(sample))
            # Whatever it is must not end Zenoh's thread, and must be seen.
            except Exception:
                log.exception("a message on %s could not be taken", sample.key_expr)

        subscriber: _Declared
        if history:
            subscriber = ext.declare_advanced_subscriber(
                self._session,
                self._full(key),
                on_sample,
                history=ext.HistoryConfig(detect_late_publishers=True),
                recovery=ext.RecoveryConfig(heartbeat=True, periodic_queries=None),
            )
        else:
            subscriber = self._session.declare_subscriber(self._full(key), on_sample)
        with self._lock:
            self._declared.append(subscriber)

    def queryable(self, key: str, callback: Callable[[Query], Reply | Iterable[Reply]]) -> None:
        """Answer queries.

        Args:
            key: under the prefix; may have wildcards.
            callback: gives the answer or the answers, one query after the other in one thread; what it refuses
                with QueryRefusedError goes back as an error.
        """

        def on_query(query: zenoh.Query) -> None:
            with query:
                try:
                    self._answer(query, key, callback)
                except QueryRefusedError as refused:
                    query.reply_err(str(refused))
                except Exception:
                    log.exception("the query %s could not be answered", query.selector)
                    query.reply_err("internal error; the robot's log has it")

        queryable = self._session.declare_queryable(self._full(key), on_query)
        with self._lock:
            self._declared.append(queryable)

    def get(
        self,
        key: str,
        parameters: Mapping[str, str] | None = None,
        payload: bytes | None = None,
        timeout_s: float = DEFAULT_TIMEOUT_S,
    ) -> list[Received]:
        """Ask, and wait for all answers.

        Args:
            key: under the prefix; may have wildcards.
            parameters: go into the selector; values must not contain `;`.
            payload: goes with the query.
            timeout_s: how long to wait.

        Raises:
            QueryError: nobody answered in time, or with errors only.
        """
        selector = asking.selector(self._full(key), parameters or {})
        source = own_source(self._session, self._full(key)) if key.startswith("cmd/") else None
        found = asking.wait(self._session, selector, qos_of_query(key), timeout_s, payload, source)
        return [self._received(sample) for sample in found]

    def ask(
        self,
        key: str,
        parameters: Mapping[str, str],
        on_reply: Callable[[Received], None],
        on_end: Callable[[], None],
        timeout_s: float = DEFAULT_TIMEOUT_S,
    ) -> None:
        """Ask, and do not wait: answers come in a thread of Zenoh's.

        Args:
            key: under the prefix.
            parameters: go into the selector; values must not contain `;`.
            on_reply: called with each answer that is no error.
            on_end: called once, when no more will come, whether any came or not.
            timeout_s: after this long no more will come.
        """
        selector = asking.selector(self._full(key), parameters)
        asking.start(
            self._session,
            selector,
            qos_of_query(key),
            timeout_s,
            lambda sample: on_reply(self._received(sample)),
            on_end,
        )

    def _answer(self, query: zenoh.Query, key: str, callback: Callable[[Query], Reply | Iterable[Reply]]) -> None:
        # A query with wildcards is answered on the key that was declared, if that has none itself.
        asked = self._relative(str(query.key_expr)) if "*" in key else key
        payload = b"" if query.payload is None else query.payload.to_bytes()
        claimed = None if query.source_info is None else str(query.source_info.source_id.zid)
        who = sender(self._peers(), claimed) if asked.startswith("cmd/") else ""
        found = callback(Query(asked, parameters_of(str(query.parameters)), payload, who))
        replies = [found] if isinstance(found, Reply) else found
        for reply in replies:
            encoding = encoding_of(asked) if reply.encoding is None else reply.encoding
            # It travels as the query did.
            query.reply(self._full(asked), reply.payload, encoding=encoding)

    def _peers(self) -> list[Peer]:
        """Who may have sent a command."""
        peers = (Peer(str(link.zid), link.auth_identifier) for link in self._session.info.links())
        return [peer for peer in peers if peer.name is None or peer.name in self._commanders]

    def _publisher(self, key: str, qos: Qos | None) -> Publisher:
        publisher = self._publishers.get(key)
        if publisher is not None:
            return publisher
        with self._lock:
            publisher = self._publishers.get(key)
            if publisher is None:
                publisher = declare(self._session, self._full(key), qos_of(key) if qos is None else qos)
                self._publishers[key] = publisher
            return publisher

    def _full(self, key: str) -> str:
        return f"{self.prefix}/{key}"

    def _relative(self, key: str) -> str:
        return key.removeprefix(f"{self.prefix}/")

    def _received(self, sample: zenoh.Sample) -> Received:
        attachment = None if sample.attachment is None else sample.attachment.to_bytes()
        key = self._relative(str(sample.key_expr))
        return Received(key, sample.payload.to_bytes(), str(sample.encoding), attachment)
