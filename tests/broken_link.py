"""A TCP link on this machine that can be cut, stalled and slowed; and a robot with a map that changes at random."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable
from types import TracebackType

from robominer_slam.publishing.map_publisher import MapPublisher
from robominer_slam.publishing.map_receiver import MapReceiver
from robominer_slam.publishing.report_messages import Diagnostic, Level, diagnostics
from robominer_slam.publishing.zenoh_session import ZenohBus, ZenohSettings
from tests.secured_robot import free_ports
from tests.test_map_stream import MAP_ID, World

PREFIX = "robominer/test"
CELL = 0.03
LIMIT_S = 20.0
#: Found again at once: the tests have not the time to wait as an operator does.
RETRY = {"connect/retry": {"period_init_ms": 50, "period_max_ms": 50, "period_increase_factor": 1}}


class BrokenLink:
    """Stands between a client and a port; use it with `with`.

    Attributes:
        endpoint: for the client.
        bytes_per_s: towards the client; None: no limit.
        carried: bytes towards the client.
    """

    def __init__(self, port: int) -> None:
        [own] = free_ports(1)
        self.endpoint = f"tcp/127.0.0.1:{own}"
        self.bytes_per_s: float | None = None
        self.carried = 0
        self._port, self._own = port, own
        self._loop = asyncio.new_event_loop()
        self._flows = asyncio.Event()
        self._refusing = False
        self._writers: set[asyncio.StreamWriter] = set()
        self._thread = threading.Thread(target=self._loop.run_forever, name="broken-link", daemon=True)

    def __enter__(self) -> BrokenLink:
        self._thread.start()
        self._flows.set()
        self._server = self._call(self._listen)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.cut()
        self._call(self._end)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(LIMIT_S)
        self._loop.close()

    def cut(self) -> None:
        """Close all connections, and every new one."""
        self._call(self._close)

    def stall(self) -> None:
        """Connections stay, and nothing goes through."""
        self._loop.call_soon_threadsafe(self._flows.clear)

    def mend(self) -> None:
        """Let everything through again."""
        self._refusing = False
        self._loop.call_soon_threadsafe(self._flows.set)

    def _call(self, step):
        return asyncio.run_coroutine_threadsafe(step(), self._loop).result(LIMIT_S)

    async def _listen(self) -> asyncio.Server:
        return await asyncio.start_server(self._accept, "127.0.0.1", self._own)

    async def _close(self) -> None:
        self._refusing = True
        for writer in self._writers:
            writer.transport.abort()
        self._writers.clear()

    async def _end(self) -> None:
        self._server.close()
        tasks = asyncio.all_tasks() - {asyncio.current_task()}
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self._refusing:
            writer.transport.abort()
            return
        try:
            there, onward = await asyncio.open_connection("127.0.0.1", self._port)
        except OSError:
            writer.transport.abort()
            return
        self._writers |= {writer, onward}
        await asyncio.gather(self._pump(reader, onward, False), self._pump(there, writer, True))

    async def _pump(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, to_client: bool) -> None:
        try:
            while data := await reader.read(1024):
                await self._flows.wait()
                if to_client:
                    self.carried += len(data)
                    if self.bytes_per_s is not None:
                        await asyncio.sleep(len(data) / self.bytes_per_s)
                writer.write(data)
                await writer.drain()
        except ConnectionError:
            # The other way's end follows from it.
            pass
        finally:
            writer.transport.abort()


class WanderingRobot:
    """Publishes a map that changes at random; use it with `with`."""

    def __init__(self, seed: int, points: int = 60) -> None:
        [self.port] = free_ports(1)
        self.world = World(seed, points)
        self.bus = ZenohBus(ZenohSettings(listen=(f"tcp/127.0.0.1:{self.port}",)), PREFIX)
        self.publisher = MapPublisher(self.bus, MAP_ID, CELL)
        self._lock = threading.Lock()
        self.bus.queryable("map/snapshot", self._answer)

    def __enter__(self) -> WanderingRobot:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.bus.close()

    def _answer(self, query):
        with self._lock:
            return self.publisher.answer(query)

    def step(self) -> None:
        with self._lock:
            self.world.step()
            self.world.update(self.publisher)

    def tell(self) -> None:
        """The status, as once a second."""
        values = {"map.version": str(self.publisher.state.version), "map.digest": self.publisher.digest}
        self.bus.put("status", diagnostics(0, [Diagnostic("localization", Level.OK, "", values)]))

    def until_equal(self, receiver: MapReceiver, limit_s: float = LIMIT_S) -> float:
        """Tell and tick until the receiver has the map; the seconds that it took."""
        begun = time.monotonic()
        self.until(lambda: receiver.synchronised and receiver.digest == self.publisher.digest, receiver, limit_s)
        return time.monotonic() - begun

    def until(self, condition: Callable[[], bool], receiver: MapReceiver, limit_s: float = LIMIT_S) -> None:
        end = time.monotonic() + limit_s
        while not condition():
            assert time.monotonic() < end, (receiver.behind, dict(receiver.counters), receiver.digest)
            self.tell()
            receiver.tick()
            time.sleep(0.05)


def client(link: BrokenLink) -> ZenohBus:
    settings = ZenohSettings(connect=(link.endpoint,), mode="client", connect_timeout_s=LIMIT_S, further=RETRY)
    return ZenohBus(settings, PREFIX)
