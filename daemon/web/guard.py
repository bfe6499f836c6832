"""Who is answered, and with what headers; before anything else looks at a request."""

from __future__ import annotations

import hmac
import re
from collections.abc import Callable
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import JSONResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from daemon.web.settings import Viewers

COOKIE = "dcam"
MOST_QUERY = 4096
HEADERS = {
    "content-security-policy": "default-src 'self'; img-src 'self' blob: data:; "
    "object-src 'none'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
}
_PORT = re.compile(r":\d{1,5}$")
_OPEN = ("/static/", "/login")
"""What whoever logs in must see first."""

MessagePage = Callable[[Scope, int, str], Response]
"""Makes the answer for browsers or programs: status and one line."""


def host_name(host: str) -> str:
    """The name in a Host header, without its port, in small letters."""
    return _PORT.sub("", host.strip().lower())


class Guard:
    """Refuses other hosts (DNS rebinding), other methods, and who has no token."""

    def __init__(self, app: ASGIApp, viewers: Viewers, refuse: MessagePage) -> None:
        self._app = app
        self._viewers = viewers
        self._refuse = refuse

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        if scope["type"] != "http":
            return  # uvicorn refuses what is not answered

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers[name] = value
                headers.setdefault("cache-control", "no-store")
            await send(message)

        answer = self._refusal(scope)
        await (answer or self._app)(scope, receive, with_headers)

    def _refusal(self, scope: Scope) -> Response | None:
        headers = Headers(scope=scope)
        hosts = headers.getlist("host")
        if len(hosts) != 1 or host_name(hosts[0]) not in self._viewers.hosts:
            text = "not a name of this page; [web] hosts in the config lists them"
            return self._refuse(scope, 403, text)
        if scope["method"] not in {"GET", "HEAD"}:
            answer = JSONResponse({"error": "only GET and HEAD"}, 405)
            answer.headers["allow"] = "GET, HEAD"
            return answer
        if len(scope["query_string"]) > MOST_QUERY or len(scope["path"]) > MOST_QUERY:
            return self._refuse(scope, 414, "the address is too long")
        if self._viewers.token is None:
            return None
        path = str(scope["path"])
        if path == "/login":
            return self._login(scope)
        if path.startswith(_OPEN) or self._is_known(headers):
            return None
        return self._refuse(scope, 401, "give the token of [web] in the config")

    def _is_known(self, headers: Headers) -> bool:
        kind, _, token = headers.get("authorization", "").partition(" ")
        if kind.lower() == "bearer" and self._is_token(token.strip()):
            return True
        try:
            cookies = SimpleCookie(headers.get("cookie", ""))
        except CookieError:
            return False
        return COOKIE in cookies and self._is_token(cookies[COOKIE].value)

    def _is_token(self, given: str) -> bool:
        """Compare in a time that says nothing of where they differ."""
        token = self._viewers.token or ""
        return hmac.compare_digest(given.encode(errors="replace"), token.encode())

    def _login(self, scope: Scope) -> Response:
        query = parse_qs(scope["query_string"].decode("latin-1"))
        if not self._is_token(query.get("token", [""])[0]):
            return self._refuse(scope, 401, "give the token of [web] in the config")
        answer = RedirectResponse("/", 303)
        answer.set_cookie(
            COOKIE,
            self._viewers.token or "",
            max_age=180 * 86_400,
            httponly=True,
            samesite="strict",
            secure=scope.get("scheme") == "https",
        )
        return answer
