"""What every request passes before a page sees it, and every answer before it leaves.

Cookies say who a visitor is, so requests that change something must come from the page itself; the
names under which the server is asked for are known, so that no other site can pretend to be it
(DNS rebinding); bodies are short; visitors take their turns.
"""

import hmac
import time
from collections.abc import Callable, Sequence
from http.cookies import SimpleCookie
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders, QueryParams
from starlette.middleware import Middleware
from starlette.responses import PlainTextResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

__all__ = [
    "CSP",
    "KEY_COOKIE",
    "LOOPBACK",
    "VISITOR_COOKIE",
    "Guards",
    "Rate",
    "guards",
    "hosts_of",
]

#: Addresses that only this machine can reach.
LOOPBACK = ("127.0.0.1", "localhost", "::1")
VISITOR_COOKIE = "visitor"
KEY_COOKIE = "key"
#: Nothing but our own files runs or is loaded, and nobody frames the page.
CSP = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; "
    "form-action 'self'; frame-ancestors 'none'; base-uri 'none'"
)
_HEADERS = {
    "content-security-policy": CSP,
    "x-content-type-options": "nosniff",
    # Not "no-referrer", with which browsers say "Origin: null" of the page's own forms.
    "referrer-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
}
_MOST_BYTES = 16_384
_MOST_VISITORS = 10_000  # whose rates are remembered


def hosts_of(host: str) -> tuple[str, ...] | None:
    """Names that a server which listens on ``host`` may be asked for by; None for any."""
    if host in ("0.0.0.0", "::"):
        return None
    return tuple(dict.fromkeys([host, *(LOOPBACK if host in LOOPBACK else ())]))


class Rate:
    """How often each of many may come: a bucket of tokens for each (token bucket).

    Args:
        per_second: Tokens that come back in a second.
        burst: Tokens of a full bucket.
        clock: Tells the time in seconds.
    """

    def __init__(
        self, per_second: float, burst: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.per_second, self.burst, self.clock = per_second, burst, clock
        self._buckets: dict[str, tuple[float, float]] = {}

    def allows(self, who: str) -> bool:
        """Whether ``who`` may come now; if so, that counts."""
        now = self.clock()
        left, then = self._buckets.pop(who, (self.burst, now))
        left = min(self.burst, left + (now - then) * self.per_second)
        allowed = left >= 1
        self._buckets[who] = (left - allowed, now)  # the latest last
        if len(self._buckets) > _MOST_VISITORS:
            del self._buckets[next(iter(self._buckets))]
        return allowed


class Guards:
    """ASGI middleware with all of these checks.

    Args:
        app: What is guarded.
        hosts: Names that the server may be asked for by; None for any.
        key: Word that visitors need, in the query ``?key=`` once and in a cookie from then on; None
            for none.
        rate: How often one visitor may come.
        newcomers: How often visitors may begin, from one address.
        beginnings: Paths on which a visitor begins.
    """

    def __init__(
        self,
        app: ASGIApp,
        *,
        hosts: Sequence[str] | None,
        key: str | None,
        rate: Rate,
        newcomers: Rate,
        beginnings: Sequence[str],
    ) -> None:
        self.app, self.hosts, self.key = app, hosts, key
        self.rate, self.newcomers, self.beginnings = rate, newcomers, tuple(beginnings)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Let a request through, or answer it with the reason why not."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return

        given = False

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in _HEADERS.items():
                    headers[name] = value
                headers.setdefault("cache-control", "no-store")
                if given:
                    cookie = f"{KEY_COOKIE}={self.key}; HttpOnly; SameSite=Strict; Path=/"
                    headers.append("set-cookie", cookie)
            await send(message)

        headers = Headers(scope=scope)
        refusal = self._refusal(scope, headers)
        if refusal is None and self.key is not None:
            given = hmac.compare_digest(
                QueryParams(scope["query_string"]).get("key", "").encode(), self.key.encode()
            )
            held = _cookie(headers, KEY_COOKIE)
            if not given and not hmac.compare_digest(held.encode(), self.key.encode()):
                refusal = PlainTextResponse("open the whole link that you were given", 403)
        body: Message | None = None
        if refusal is None and scope["method"] == "POST":
            body = await _read(receive)
            if body is None:
                refusal = PlainTextResponse(f"send at most {_MOST_BYTES} bytes", 413)

        async def replay() -> Message:
            nonlocal body
            if body is None:
                return await receive()
            message, body = body, None
            return message

        await (self.app if refusal is None else refusal)(scope, replay, send_guarded)

    def _refusal(self, scope: Scope, headers: Headers) -> Response | None:
        """Why a request is not let through, by its head alone."""
        host = headers.get("host", "")
        name = urlsplit(f"//{host}").hostname or ""
        if self.hosts is not None and name not in self.hosts:
            return PlainTextResponse("this server has another name", 421)
        if scope["method"] not in ("GET", "HEAD", "POST"):
            return PlainTextResponse("only GET, HEAD and POST", 405)
        address = (scope.get("client") or ("unknown",))[0]
        if scope["method"] == "POST":
            origin = headers.get("origin")
            foreign = origin is not None and urlsplit(origin).netloc != host
            if foreign or headers.get("sec-fetch-site", "none") not in ("same-origin", "none"):
                return PlainTextResponse("answers must come from the page itself", 403)
            if scope["path"] in self.beginnings and not self.newcomers.allows(address):
                return _later("too many people begin at once; try again in a minute")
        who = headers.get("authorization") or _cookie(headers, VISITOR_COOKIE) or address
        if not self.rate.allows(who[:100]):
            return _later("too many requests; wait a moment")
        return None


def guards(
    *, hosts: tuple[str, ...] | None, key: str | None, rate: float, newcomers: int
) -> Middleware:
    """The checks of every request, see ``Guards``.

    Args:
        hosts: Names that the server may be asked for by; None for any.
        key: Word that visitors need; None for none.
        rate: Requests per second of one visitor, on average.
        newcomers: Visitors who may begin in a minute, from one address.
    """
    return Middleware(
        Guards,
        hosts=hosts,
        key=key,
        rate=Rate(rate, 3 * rate + 10),
        newcomers=Rate(newcomers / 60, newcomers),
        beginnings=("/start", "/api/start"),
    )


def _later(why: str) -> Response:
    return PlainTextResponse(why, 429, {"retry-after": "5"})


def _cookie(headers: Headers, name: str) -> str:
    found = SimpleCookie(headers.get("cookie", "")).get(name)
    return "" if found is None else found.value


async def _read(receive: Receive) -> Message | None:
    """The whole body as one message; None if it is too long or never came."""
    parts, length, more = [], 0, True
    while more:
        message = await receive()
        if message["type"] == "http.disconnect":
            return None
        part = message.get("body", b"")
        parts.append(part)
        length, more = length + len(part), message.get("more_body", False)
        if length > _MOST_BYTES:
            return None
    return {"type": "http.request", "body": b"".join(parts), "more_body": False}
