"""Access to the panel: who may ask, from where, and how much; checked before anything is done."""

import hmac
import secrets
from collections.abc import Collection
from urllib.parse import parse_qs

from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

#: Largest message on the socket, and largest body of a request [bytes].
MOST_BYTES = 65_536

#: Everything comes from this server, and nothing is written into a page.
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; "
    "font-src 'self'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
)
_HEADERS = {
    "Content-Security-Policy": _POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}
_READS = ("GET", "HEAD")


class Access:
    """Credentials of a request: the server's own name, its token, and its own origin.

    Attributes:
        token: Word that the command prints; who has it may use the panel.
        scheme: http or https.
        cookie: Name of the cookie that has the token.
    """

    def __init__(self, names: Collection[str], port: int, tls: bool) -> None:
        """Make a token.

        Args:
            names: Names and addresses of this server, as they stand in a URL.
            port: Its port.
            tls: True if it is reached by https.
        """
        self.token = secrets.token_urlsafe(32)
        self.scheme = "https" if tls else "http"
        self.cookie = f"canwall-{port}"
        self._hosts = {f"{name.lower()}:{port}" for name in names}
        if port == (443 if tls else 80):  # which browsers leave out
            self._hosts |= {name.lower() for name in names}
        self._ticket: str | None = None

    def ticket(self) -> str:
        """Return a word that lets one page in, once.

        The command line of a browser, which others on this machine can read, has that instead of
        the token.
        """
        self._ticket = secrets.token_urlsafe(32)
        return self._ticket

    def lets_in(self, given: str) -> bool:
        """Return True for the token, and once for the ticket."""
        if _equal(given, self.token):
            return True
        if self._ticket is not None and _equal(given, self._ticket):
            self._ticket = None
            return True
        return False

    def refusal(self, scope: Scope) -> Response | None:
        """Return the answer to a request that is refused, None for one that is not."""
        headers = Headers(scope=scope)
        host = headers.get("host", "").lower()
        if host not in self._hosts:
            return _refused(
                421,
                f"this server is {', '.join(sorted(self._hosts))}, not what the address of the "
                "request says; through a tunnel, use the same port at both ends",
            )
        bearer = self._is_bearer(headers)
        if not bearer and not self._has_cookie(headers):
            return _refused(
                403, "no token, or not that of this panel: open the address that it printed"
            )
        changes = scope["type"] == "websocket" or scope["method"] not in _READS
        if changes and not self._is_own_origin(headers, host, bearer):
            return _refused(403, "the request comes from another page than the panel's own")
        return None

    def _is_bearer(self, headers: Headers) -> bool:
        kind, _, given = headers.get("authorization", "").partition(" ")
        return kind.lower() == "bearer" and _equal(given.strip(), self.token)

    def _has_cookie(self, headers: Headers) -> bool:
        # Those of other servers of this host are here as well, whatever they look like.
        cookies = (pair.strip().partition("=") for pair in headers.get("cookie", "").split(";"))
        return any(name == self.cookie and _equal(value, self.token) for name, _, value in cookies)

    def _is_own_origin(self, headers: Headers, host: str, bearer: bool) -> bool:
        origin = headers.get("origin")
        if origin is None:
            return bearer  # a program; browsers say where a request comes from
        return origin.lower() == f"{self.scheme}://{host}"

    def entrance(self, scope: Scope) -> Response | None:
        """Return the answer to `GET /?token=…`, which sets the cookie; None for other requests."""
        if scope["type"] != "http" or scope["path"] != "/" or scope["method"] != "GET":
            return None
        given = parse_qs(scope["query_string"].decode("latin-1")).get("token")
        if given is None or Headers(scope=scope).get("host", "").lower() not in self._hosts:
            return None
        if not self.lets_in(given[0]):
            return _refused(403, "not the token of this panel: open the address that it printed")
        answer = RedirectResponse("/", status_code=303)
        answer.set_cookie(
            self.cookie,
            self.token,
            path="/",
            secure=self.scheme == "https",
            httponly=True,
            samesite="strict",
        )
        return answer


class Guarded:
    """ASGI application behind the checks of an `Access`."""

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self._app = app
        self._access = access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or have the application answer it."""
        if scope["type"] not in ("http", "websocket"):
            raise RuntimeError(f"{scope['type']}: not served")

        async def guarded_send(message: Message) -> None:
            if message["type"] in ("http.response.start", "websocket.http.response.start"):
                headers = MutableHeaders(scope=message)
                for name, value in _HEADERS.items():
                    headers[name] = value
            await send(message)

        answer = self._access.entrance(scope) or self._access.refusal(scope)
        if answer is not None:
            await answer(scope, receive, guarded_send)
            return
        if scope["type"] == "websocket":
            await self._app(scope, receive, guarded_send)
            return
        taken = 0

        async def bounded_receive() -> Message:
            nonlocal taken
            message = await receive()
            taken += len(message.get("body", b""))
            if taken > MOST_BYTES:
                raise HTTPException(413, f"canwall: a body of more than {MOST_BYTES} bytes")
            return message

        await self._app(scope, bounded_receive, guarded_send)


def _refused(status: int, text: str) -> Response:
    return PlainTextResponse(f"canwall: {text}\n", status)


def _equal(given: str, expected: str) -> bool:
    return hmac.compare_digest(given.encode("utf-8", "surrogateescape"), expected.encode())
