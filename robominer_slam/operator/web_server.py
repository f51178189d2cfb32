"""The web server: NiceGUI's page, the stream beside it, files to save; guarded by `access.py`."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import math
import re
import socket
import threading
import webbrowser
from collections.abc import Callable, Iterator

import uvicorn
from fastapi import FastAPI, WebSocket, WebSocketDisconnect
from fastapi.responses import Response
from nicegui import ui

from robominer_slam.operator import exports
from robominer_slam.operator.access import AccessGuard, is_loopback
from robominer_slam.operator.page import build_page
from robominer_slam.operator.readings import ProcessorMeter
from robominer_slam.operator.saved_maps import FORMATS
from robominer_slam.operator.session import Session
from robominer_slam.operator.stream import PageStream
from robominer_slam.publishing.bus_messages import QueryError

log = logging.getLogger(__name__)

#: Pages that are still open get this long to go when the program ends, s.
GRACE_S = 1
_EXPORTS: dict[str, Callable[..., bytes]] = {
    "map.ply": exports.ply,
    "keyframes.tum": exports.keyframes_tum,
    "poses.tum": exports.poses_tum,
}


class ServerError(Exception):
    """An address that cannot be served; one line says why and what to do."""


class _Server(uvicorn.Server):
    """Ends on a signal without passing it on: who asks the program to end wants exit code 0."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """See uvicorn: there the signal is raised again at the end."""
        import signal

        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before = {number: signal.signal(number, self.handle_exit) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


def application(session: Session, token: str | None) -> FastAPI:
    """The whole web application for one robot."""
    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)
    meter = ProcessorMeter()

    @app.websocket("/stream")
    async def stream(page: WebSocket) -> None:
        await page.accept()
        follower = PageStream(session.view, page, meter)
        tasks = [asyncio.create_task(follower.run()), asyncio.create_task(_receive(page, follower))]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in tasks:
                task.cancel()
            ended = await asyncio.gather(*tasks, return_exceptions=True)
        for error in ended:
            # A page that goes away ends with one of these; the page asks anew after anything else.
            if isinstance(error, Exception) and not isinstance(error, (WebSocketDisconnect, RuntimeError)):
                log.error("a page's stream has failed", exc_info=error)

    @app.get("/export/{name}")
    def export(name: str) -> Response:
        if name not in _EXPORTS:
            return _not_found(f"expected one of {', '.join(_EXPORTS)}")
        return _file(session.robot, name, _EXPORTS[name](session.view))

    @app.get("/saved/{number}.{ending}")
    def saved(number: int, ending: str) -> Response:
        if ending not in FORMATS:
            return _not_found(f"expected an ending of {', '.join(FORMATS)}")
        try:
            state = session.saved_map(number)
        except QueryError as error:
            return _not_found(str(error))
        return _file(session.robot, f"map-{number}.{ending}", FORMATS[ending](state))

    ui.page("/")(lambda: build_page(session))
    ui.run_with(
        app,
        title=f"{session.robot} – operator",
        # Our own style sheet is enough; Tailwind's compiler would cost the page's main thread.
        tailwind=False,
        show_welcome_message=False,
        dark=None,
    )
    app.add_middleware(AccessGuard, token=token)
    return app


def _not_found(why: str) -> Response:
    return Response(f"{why}\n", status_code=404, media_type="text/plain")


def _file(robot: str, name: str, content: bytes) -> Response:
    robot = re.sub(r"[^A-Za-z0-9_.-]", "_", robot)
    headers = {"Content-Disposition": f'attachment; filename="{robot}-{name}"'}
    return Response(content, media_type="application/octet-stream", headers=headers)


def listening_socket(host: str, port: int) -> socket.socket:
    """A socket that listens there; port 0: any free one.

    Raises:
        ServerError: the address is taken or not of this machine.
    """
    try:
        return socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET)
    except (OSError, OverflowError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise ServerError(f"--host {host} --port {port}: {reason}; give another --port, or 0 for any") from error


def serve(
    session: Session, listener: socket.socket, token: str | None, *, on_ready: Callable[[str], None], browse: bool
) -> None:
    """Serve until SIGTERM or SIGINT.

    Args:
        session: what is shown.
        listener: from `listening_socket`.
        token: that others need; None: none is asked for, on loopback only.
        on_ready: told the address once the page can be opened.
        browse: open it in a browser on this machine.
    """
    host, port = listener.getsockname()[:2]
    shown = f"[{host}]" if ":" in host else host
    address = f"http://{shown}:{port}/" + (f"?token={token}" if token else "")
    assert token is not None or is_loopback(host)
    config = uvicorn.Config(
        application(session, token), log_level="warning", timeout_graceful_shutdown=GRACE_S, ws_max_size=1 << 16
    )
    server = _Server(config)

    def tell_when_ready() -> None:
        while not server.started and not server.should_exit:
            threading.Event().wait(0.02)
        if server.started:
            on_ready(address)
            if browse:
                webbrowser.open(address)

    threading.Thread(target=tell_when_ready, name="operator-ready", daemon=True).start()
    server.run(sockets=[listener])


async def _receive(page: WebSocket, follower: PageStream) -> None:
    """Take which moment the page looks at, until it goes away or sends what is no such message."""
    while True:
        try:
            stamp = json.loads(await page.receive_text())["seek"]
        except (ValueError, KeyError, TypeError) as error:
            log.warning("a page sent what is no moment: %s", error)
            return
        follower.seek_ns = int(stamp * 1_000_000) if _is_stamp(stamp) else None


def _is_stamp(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
