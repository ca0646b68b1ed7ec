"""Web server of the panel: the page, its socket, and the checks in front of them."""

import asyncio
import contextlib
import ipaddress
import mimetypes
import socket
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import h11
import uvicorn
from pydantic import ValidationError
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import BaseRoute, Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp
from starlette.websockets import WebSocket, WebSocketDisconnect
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from canwall.config import ConfigError, check_values, first_error
from canwall.errors import InputError, one_line
from canwall.panel.messages import Start, parse
from canwall.panel.pages import MOST_PAGES, Page
from canwall.panel.security import MOST_BYTES, Access, Guarded
from canwall.panel.session import Session
from canwall.strict_json import as_json

_PAGE = Path(__file__).parent / "page"
_UPLOT = {"uPlot.js": "uPlot.iife.js", "uPlot.css": "uPlot.min.css"}

#: Connections at a time, and how long one may take for its request, or to read a little [s].
_MOST_CONNECTIONS, _PATIENCE_S = 64, 5.0
#: Buffer of the kernel for each connection: what a slow reader is behind is bounded by it [bytes].
_SEND_BUFFER = 65_536
#: Requests of one page that wait for their answers; one that lets more of them wait is closed.
_MOST_OF_A_PAGE = 64


def make_app(session: Session, access: Access, more: Sequence[BaseRoute] = ()) -> ASGIApp:
    """Make the application behind its checks.

    Args:
        session: The panel.
        access: The checks.
        more: Further routes, of recorded runs.
    """
    for kind, suffix in (("text/javascript", ".js"), ("image/svg+xml", ".svg")):
        mimetypes.add_type(kind, suffix)  # whatever this machine says

    async def page(request: Request) -> Response:
        return FileResponse(_PAGE / "index.html")

    async def uplot(request: Request) -> Response:
        name = _UPLOT.get(request.path_params["name"])
        if name is None:
            return PlainTextResponse("Not Found", 404)
        return FileResponse(_uplot_folder() / name)

    async def configs(request: Request) -> Response:
        return _json({"configs": await run_in_threadpool(session.launcher.listed)})

    async def start(request: Request) -> Response:
        message = parse((await request.body()).decode(errors="replace"))
        check_values(message)
        try:
            given = Start.model_validate(message)
        except ValidationError as error:
            raise ConfigError(first_error(error, Start)) from None
        return _json({"ok": True} | await session.start(given))

    async def live(socket: WebSocket) -> None:
        if len(session.pages) >= MOST_PAGES:
            text = f"canwall: {MOST_PAGES} pages are open; close one of them\n"
            await socket.send_denial_response(PlainTextResponse(text, 503))
            return
        await socket.accept()
        await _serve_page(socket, session)

    routes = [
        Route("/", page),
        Mount("/static", StaticFiles(directory=_PAGE, check_dir=False)),
        Route("/uplot/{name}", uplot),
        Route("/api/configs", configs),
        Route("/api/start", start, methods=["POST"]),
        WebSocketRoute("/live", live),
        *more,
    ]
    return Guarded(Starlette(routes=routes, exception_handlers={InputError: _refuse}), access)


async def _refuse(request: Request, error: Exception) -> Response:
    return _json({"ok": False, "error": str(error)}, 400)


def _json(content: Any, status: int = 200) -> Response:
    return Response(as_json(content), status, media_type="application/json")


def _uplot_folder() -> Path:
    found = find_spec("uplot")
    assert found is not None
    assert found.submodule_search_locations is not None
    return Path(found.submodule_search_locations[0]) / "static"


async def _serve_page(socket: WebSocket, session: Session) -> None:
    """Send a page what it is to get and answer what it asks for, until it closes."""
    page = session.pages.open()
    sending = asyncio.create_task(_send(socket, page))
    answering: set[asyncio.Task[None]] = set()
    try:
        while not sending.done():
            receiving = asyncio.create_task(socket.receive_text())
            await asyncio.wait((receiving, sending), return_when=asyncio.FIRST_COMPLETED)
            if not receiving.done():
                receiving.cancel()
                break
            text = receiving.result()
            if len(answering) >= _MOST_OF_A_PAGE:
                break
            task = asyncio.create_task(_answer(text, page, session))
            answering.add(task)
            task.add_done_callback(answering.discard)
    except (WebSocketDisconnect, KeyError):  # KeyError: a message of bytes, which no page sends
        pass
    finally:
        session.pages.close(page)
        sending.cancel()
        with contextlib.suppress(RuntimeError, WebSocketDisconnect):
            await socket.close(1008)


async def _send(socket: WebSocket, page: Page) -> None:
    with contextlib.suppress(WebSocketDisconnect, RuntimeError):
        while (message := await page.outbox.get()) is not None:
            if isinstance(message, str):
                await socket.send_text(message)
            else:
                await socket.send_bytes(message)


async def _answer(text: str, page: Page, session: Session) -> None:
    number: Any = None
    try:
        message = parse(text)
        number = message.get("id")
        if not isinstance(number, int):
            raise ConfigError("id: has to be an integer")
        check_values(message)
        answer = await session.answer(page, message)
    except ConfigError as error:
        answer = {"ok": False, "error": str(error)}
    page.outbox.put_event(as_json({"answer": number} | answer))


class _Bounded:
    """Connection that is closed if it takes its time, or if there are too many."""

    transport: asyncio.Transport
    connections: set[Any]

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._deadlines: dict[str, asyncio.TimerHandle] = {}

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)  # type: ignore[misc]
        if len(self.connections) > _MOST_CONNECTIONS:
            transport.abort()

    def connection_lost(self, error: Exception | None) -> None:
        for what in list(self._deadlines):
            self._relax(what)
        super().connection_lost(error)  # type: ignore[misc]

    def pause_writing(self) -> None:
        super().pause_writing()  # type: ignore[misc]
        self._hurry("reads")

    def resume_writing(self) -> None:
        super().resume_writing()  # type: ignore[misc]
        self._relax("reads")

    def _hurry(self, what: str) -> None:
        """Close the connection soon, unless `_relax` is called before."""
        if what not in self._deadlines:
            loop = asyncio.get_running_loop()
            self._deadlines[what] = loop.call_later(_PATIENCE_S, self.transport.abort)

    def _relax(self, what: str) -> None:
        if what in self._deadlines:
            self._deadlines.pop(what).cancel()


class _Http(_Bounded, H11Protocol):
    """Connection whose requests have to come whole, and in time."""

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self._hurry("asks")

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        is_socket = self.transport.get_protocol() is not self
        if self.conn.their_state in (h11.IDLE, h11.SEND_BODY) and not is_socket:
            self._hurry("asks")
        else:
            self._relax("asks")


class _WebSocket(_Bounded, WebSocketsSansIOProtocol):
    """Socket of a page, closed without its consent once there is nothing more to say."""

    async def send(self, message: Any) -> None:
        await super().send(message)
        if message["type"] == "websocket.http.response.body":
            self.handshake_complete = True  # a refusal is one; uvicorn logs that there was none

    async def run_asgi(self) -> None:
        await super().run_asgi()
        self._hurry("closes")


class _Server(uvicorn.Server):
    """Server that begins with the session, and says when it listens."""

    def __init__(self, settings: uvicorn.Config, session: Session, say: Callable[[], None]) -> None:
        super().__init__(settings)
        self._session = session
        self._say = say

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        self._session.begin()
        self._say()

    async def on_tick(self, counter: int) -> bool:
        return await super().on_tick(counter) or self._session.is_done()


@dataclass(frozen=True)
class Certificate:
    """Files of a certificate for TLS, and of its key."""

    certificate: Path
    key: Path


class PanelServer:
    """A panel and the socket on which it listens from the beginning.

    Attributes:
        port: Port.
        url: Address of the page, without the token.
        access: What a request has to bring.
    """

    def __init__(
        self,
        session: Session,
        more: Sequence[BaseRoute] = (),
        host: str = "127.0.0.1",
        port: int = 0,
        tls: Certificate | None = None,
    ) -> None:
        """Listen.

        Args:
            session: The panel.
            more: Further routes, of recorded runs.
            host: Name or address of this machine.
            port: Port; 0: a free one.
            tls: Certificate; without, only programs on this machine can reach it.

        Raises:
            InputError: If the address cannot be had, needs TLS, or the certificate cannot be used.
        """
        address, family = _address(host)
        if not address.is_loopback and tls is None:
            raise InputError(
                f"--host {host}: whoever is on the network could read the token; give --tls-cert "
                f"and --tls-key, or leave out --host and use a tunnel, for example "
                f"ssh -L PORT:localhost:PORT with the same PORT twice"
            )
        self._socket = _listening(str(address), port, family)
        self.port = int(self._socket.getsockname()[1])
        names = {"127.0.0.1", "localhost", "[::1]"} if address.is_loopback else set()
        shown = f"[{host}]" if ":" in host else host
        self.access = Access({*names, shown}, self.port, tls is not None)
        self.url = f"{self.access.scheme}://{shown}:{self.port}/"
        self._session = session
        options: dict[str, Any] = {}
        if tls is not None:
            options = {"ssl_certfile": tls.certificate, "ssl_keyfile": tls.key}
        self._settings = uvicorn.Config(
            make_app(session, self.access, more),
            http=_Http,
            ws=_WebSocket,
            ws_max_size=MOST_BYTES,
            ws_ping_interval=_PATIENCE_S,
            ws_ping_timeout=_PATIENCE_S,
            ws_per_message_deflate=False,
            loop="asyncio",
            lifespan="off",
            log_level="warning",
            access_log=False,
            proxy_headers=False,
            server_header=False,
            limit_concurrency=2 * _MOST_CONNECTIONS,  # those above the bound are closed unheard
            timeout_graceful_shutdown=1,
            **options,
        )
        try:
            self._settings.load()
        except OSError as error:
            self._socket.close()
            raise InputError(f"--tls-cert, --tls-key: cannot be used: {error}") from None

    def serve(self, say: Callable[[], None]) -> None:
        """Serve until a signal ends it, which is raised again; the run goes on.

        Args:
            say: Called once pages are served.
        """
        self._server = _Server(self._settings, self._session, say)
        try:
            self._server.run(sockets=[self._socket])
        finally:
            self._session.end()

    def end(self) -> None:
        """Have `serve` come back; from any thread."""
        self._server.should_exit = True


def _address(
    host: str,
) -> tuple[ipaddress.IPv4Address | ipaddress.IPv6Address, socket.AddressFamily]:
    """Return the address of a name of this machine. Raises InputError."""
    try:
        family, _, _, _, found = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        address = ipaddress.ip_address(found[0])
    except (OSError, ValueError, UnicodeError) as error:
        raise InputError(f"--host {host}: no address of this machine: {error}") from None
    if address.is_unspecified:
        raise InputError(
            f"--host {host}: stands for all names of this machine; give the one by which the page "
            "is opened"
        )
    return address, family


def _listening(host: str, port: int, family: socket.AddressFamily) -> socket.socket:
    """Return a socket that listens. Raises InputError."""
    try:
        listener = socket.create_server((host, port), family=family)
    except (OSError, OverflowError) as error:
        raise InputError(f"--host {host} --port {port}: {one_line(str(error))}") from None
    # Connections have it from here.
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
    return listener
