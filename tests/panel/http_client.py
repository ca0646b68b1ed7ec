"""Requests to routes, without a socket."""

import asyncio
from pathlib import Path
from typing import Any

import httpx2
from starlette.applications import Starlette

from canwall.panel.recorded import routes


class Client:
    """A client of the routes to a folder."""

    def __init__(self, root: Path) -> None:
        self._transport = httpx2.ASGITransport(Starlette(routes=routes(root)))

    def get(self, path: str) -> httpx2.Response:
        return self._request("GET", path)

    def post(self, path: str, **content: Any) -> httpx2.Response:
        return self._request("POST", path, **content)

    def _request(self, method: str, path: str, **content: Any) -> httpx2.Response:
        async def request() -> httpx2.Response:
            async with httpx2.AsyncClient(
                transport=self._transport, base_url="http://panel"
            ) as client:
                return await client.request(method, path, **content)

        return asyncio.run(request())
