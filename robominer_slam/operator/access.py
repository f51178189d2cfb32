"""Who may open the console: everyone on this machine, or who has the token; and no other site's pages."""

from __future__ import annotations

import hmac
import ipaddress
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs, urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse, RedirectResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

COOKIE = "robominer_operator"
#: WebSocket close code for a refusal.
POLICY_VIOLATION = 1008


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches a server that listens there."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


class AccessGuard:
    """ASGI middleware: 401 without the token; 403 for WebSockets that another site's page opens.

    Without a token the server listens on loopback; then the name asked for must be one of loopback too, or any site
    could point a name of its own at this machine and read along.
    """

    def __init__(self, app: ASGIApp, token: str | None) -> None:
        self._app, self._token = app, token

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass on what may pass."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        origin, host = headers.get("origin"), headers.get("host", "")
        if origin is not None and urlsplit(origin).netloc != host:
            await _refuse(scope, receive, send, 403, "another site's page may not use this console")
        elif self._token is None and not is_loopback(urlsplit(f"//{host}").hostname or ""):
            await _refuse(scope, receive, send, 403, "this console answers to localhost only")
        elif self._token is None or self._matches(_cookie(headers)):
            await self._app(scope, receive, _unframed(send))
        elif scope["type"] == "http" and self._matches(_asked(scope)):
            # The token goes into a cookie and out of the address, where others would see it.
            response = RedirectResponse(scope["path"], status_code=303)
            response.set_cookie(COOKIE, self._token, httponly=True, samesite="lax")
            await response(scope, receive, send)
        else:
            await _refuse(scope, receive, send, 401, "this console needs its token: open /?token=...")

    def _matches(self, offered: str) -> bool:
        return self._token is not None and hmac.compare_digest(offered.encode(), self._token.encode())


def _unframed(send: Send) -> Send:
    """Answers that no other page may show inside itself: clicks on that one would command the robot."""

    async def sending(message: Message) -> None:
        if message["type"] == "http.response.start":
            MutableHeaders(scope=message)["Content-Security-Policy"] = "frame-ancestors 'none'"
        await send(message)

    return sending


def _cookie(headers: Headers) -> str:
    try:
        morsel = SimpleCookie(headers.get("cookie", "")).get(COOKIE)
    except CookieError:
        return ""
    return morsel.value if morsel is not None else ""


def _asked(scope: Scope) -> str:
    query: str = scope["query_string"].decode("latin-1")
    return parse_qs(query).get("token", [""])[0]


async def _refuse(scope: Scope, receive: Receive, send: Send, code: int, reason: str) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": POLICY_VIOLATION, "reason": reason})
        return
    await PlainTextResponse(reason + "\n", status_code=code)(scope, receive, send)
