"""Who may talk to the operator page and its viewer: token, Host, Origin and size are checked before all else."""

import secrets
from collections.abc import Callable, Collection
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs

from starlette.datastructures import Headers
from starlette.responses import JSONResponse, PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

MAX_BODY_BYTES = 16 * 1024
READING = ("GET", "HEAD")


class Guard:
    """ASGI middleware in front of everything.

    A first visit with ``?token=`` gets the token as a cookie that scripts cannot read and other sites cannot send, and
    is sent on to the address without it. Everything else needs the cookie. What changes state needs an ``Origin`` of
    this page and JSON besides. There are no websockets; one that is tried is refused.

    Parameters
    ----------
    app
        What is guarded.
    token
        The secret.
    hosts
        ``host:port`` under which the page may be asked for.
    policy
        Content security policy.
    cookie
        Name of the cookie; another for every port, since browsers do not tell ports apart.
    refused
        Told of every refusal, in words.
    framed
        Other pages may show it in a frame, as far as the policy lets them.
    """

    def __init__(
        self,
        app: ASGIApp,
        token: str,
        hosts: Collection[str],
        policy: str,
        refused: Callable[[str], None],
        cookie: str = "atmd",
        *,
        framed: bool = False,
    ) -> None:
        self._cookie = cookie
        self._app, self._token, self._hosts = app, token, frozenset(h.lower() for h in hosts)
        self._refused = refused
        self._headers = {
            "Content-Security-Policy": policy,
            "X-Content-Type-Options": "nosniff",
            "Referrer-Policy": "no-referrer",
            "Cross-Origin-Opener-Policy": "same-origin",
            "Cross-Origin-Resource-Policy": "same-origin",
        }
        if not framed:
            self._headers["X-Frame-Options"] = "DENY"

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer, refuse or pass on."""
        if scope["type"] == "websocket":
            self._refused("websocket refused: the page has none")
            await send({"type": "websocket.close", "code": 1008})
            return
        if scope["type"] != "http":
            return
        answer = self._objection(scope)
        if answer is not None:
            await answer(scope, receive, self._with_headers(send))
            return
        if scope["method"] in READING:
            await self._app(scope, receive, self._with_headers(send))
            return
        body = await _body(receive)
        if body is None:
            answer = self._refuse(scope, 413, "the message is too large")
            await answer(scope, receive, self._with_headers(send))
            return
        waiting: list[Message] = [{"type": "http.request", "body": body, "more_body": False}]

        async def replayed() -> Message:
            return waiting.pop() if waiting else await receive()

        await self._app(scope, replayed, self._with_headers(send))

    def _objection(self, scope: Scope) -> Response | None:
        headers, method = Headers(scope=scope), scope["method"]
        host = headers.get("host", "").lower()
        if host not in self._hosts or len(headers.getlist("host")) != 1:
            return self._refuse(scope, 400, "this page has another host name")
        if method == "GET" and scope["path"] == "/" and b"token=" in scope.get("query_string", b""):
            return self._welcome(scope)
        if not self._knows(headers):
            return self._refuse(scope, 401, "open the address that was printed at the start, with its token")
        if method in READING:
            return None
        if headers.get("origin", "").lower() != f"http://{host}":
            return self._refuse(scope, 403, "the request comes from another page")
        if headers.get("content-type", "").split(";")[0].strip().lower() != "application/json":
            return self._refuse(scope, 415, "requests are JSON")
        length = headers.get("content-length", "0")
        if not length.isdecimal() or int(length[:12]) > MAX_BODY_BYTES:
            return self._refuse(scope, 413, "the message is too large")
        return None

    def _knows(self, headers: Headers) -> bool:
        try:
            cookie = SimpleCookie(headers.get("cookie", "")).get(self._cookie)
        except CookieError:
            return False
        return cookie is not None and self._same(cookie.value)

    def _same(self, given: str) -> bool:
        return secrets.compare_digest(given.encode(errors="replace"), self._token.encode())

    def _welcome(self, scope: Scope) -> Response:
        given = parse_qs(scope["query_string"].decode("latin-1")).get("token", [""])[0]
        if not self._same(given):
            return self._refuse(scope, 401, "the token is not the one that was printed at the start")
        answer = RedirectResponse("/", status_code=303)
        answer.set_cookie(self._cookie, self._token, httponly=True, samesite="strict", path="/")
        return answer

    def _refuse(self, scope: Scope, status: int, reason: str) -> Response:
        self._refused(f"{scope['method'][:10]} {scope['path'][:60]!r} refused: {reason}")
        if scope["method"] == "GET" and not scope["path"].startswith("/api/"):
            return PlainTextResponse(reason, status_code=status)
        return JSONResponse({"reason": reason}, status_code=status)

    def _with_headers(self, send: Send) -> Callable[[Message], Any]:
        async def sending(message: Message) -> None:
            if message["type"] == "http.response.start":
                extra = [(k.lower().encode(), v.encode()) for k, v in self._headers.items()]
                found = {k for k, _ in message.get("headers", [])}
                if b"cache-control" not in found:
                    extra.append((b"cache-control", b"no-store"))
                message["headers"] = [*message.get("headers", []), *extra]
            await send(message)

        return sending


async def _body(receive: Receive) -> bytes | None:
    """Read the whole body; None if it grows past what is taken, or is broken off."""
    body = b""
    while True:
        message = await receive()
        if message["type"] != "http.request":
            return None
        body += bytes(message.get("body", b""))
        if len(body) > MAX_BODY_BYTES:
            return None
        if not message.get("more_body", False):
            return body
