"""Recorded runs and sweeps over HTTP. Only the strike of a sweep, which takes a while, is a POST.

An error is a line of JSON: 400 for a request that is none, 404 for what does not exist, 409 for a
run in progress, 422 for what cannot be used.
"""

import json
import math
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from canwall.errors import InputError, RunFailedError
from canwall.panel.recorded_runs import InProgressError, RecordedRuns
from canwall.panel.shelf import NotThereError, Shelf
from canwall.panel.sweeps import Sweeps
from canwall.strict_json import as_json

#: Points of an answer to a page that does not say how many it wants.
_POINTS = 1000

Endpoint = Callable[[Request], Awaitable[Response]]


class RequestError(InputError):
    """A request that is none."""


def routes(root: Path) -> list[Route]:
    """Return the routes to the runs and sweeps below a folder.

    Args:
        root: The folder; or a single run, or a single sweep.
    """
    shelf = Shelf(root)
    runs, sweeps = RecordedRuns(shelf), Sweeps(shelf)

    async def contents(request: Request) -> Response:
        return _json(await run_in_threadpool(shelf.contents))

    async def run(request: Request) -> Response:
        return _json(await run_in_threadpool(runs.describe, _word(request)))

    async def signals(request: Request) -> Response:
        interval = _number(request, "from", -math.inf), _number(request, "to", math.inf)
        points = _number(request, "points", _POINTS)
        return _binary(await run_in_threadpool(runs.signals, _word(request), *interval, points))

    async def sweep(request: Request) -> Response:
        chosen = {name: _whole(value, name) for name, value in request.query_params.items()}
        return _json(await run_in_threadpool(sweeps.map, _word(request), chosen))

    async def strike(request: Request) -> Response:
        try:
            asked = json.loads(await request.body())["indices"]
            indices = {name: _whole(value, name) for name, value in asked.items()}
        except (ValueError, TypeError, LookupError, AttributeError, RecursionError):
            raise RequestError('the request: has to be {"indices": {AXIS: NUMBER}}') from None
        return _binary(await run_in_threadpool(sweeps.strike, _word(request), indices))

    return [
        Route("/api/recorded", _answering(contents)),
        Route("/api/recorded/{id}", _answering(run)),
        Route("/api/recorded/{id}/signals", _answering(signals)),
        Route("/api/sweep/{id}", _answering(sweep)),
        Route("/api/sweep/{id}/strike", _answering(strike), methods=["POST"]),
    ]


def _answering(endpoint: Endpoint) -> Endpoint:
    """Have an endpoint answer with its error."""

    async def answer(request: Request) -> Response:
        try:
            return await endpoint(request)
        except (InputError, RunFailedError) as error:
            return JSONResponse({"error": str(error)}, _status(error))

    return answer


def _status(error: Exception) -> int:
    match error:
        case RequestError():
            return 400
        case NotThereError():
            return 404
        case InProgressError():
            return 409
    return 422


def _word(request: Request) -> str:
    return str(request.path_params["id"])


def _number(request: Request, name: str, default: float) -> float:
    """Return a number of the query. Raises RequestError if it is none."""
    text = request.query_params.get(name)
    try:
        value = default if text is None else float(text)
    except ValueError:
        value = math.nan
    if math.isnan(value):
        raise RequestError(f"{name} = {text!r}: has to be a number")
    return value


def _whole(value: Any, name: str) -> int:
    try:
        return int(value)
    except (ValueError, TypeError, OverflowError):
        raise RequestError(f"{name} = {value!r}: has to be a whole number") from None


def _json(content: Any) -> Response:
    return Response(as_json(content), media_type="application/json")


def _binary(content: bytes) -> Response:
    return Response(content, media_type="application/octet-stream")
