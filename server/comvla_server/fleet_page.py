"""The page for people who watch the fleet: its files, its events, and what a browser may do with it."""

from __future__ import annotations

import asyncio
import hashlib
from collections.abc import Callable
from functools import cache
from importlib.resources import files
from typing import Any

from fastapi import FastAPI, HTTPException, Request, Response
from pydantic import BaseModel

from comvla_server.admin_auth import ADMITTED
from comvla_server.fleet import Fleet
from comvla_server.fleet_feed import FleetFeed, TooManyWatchersError, Watcher

_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".svg": "image/svg+xml",
}

# The page loads nothing from elsewhere, runs nothing but its own files, and is in nobody's frame.
_POLICY = "; ".join(
    (
        "default-src 'none'",
        "script-src 'self'",
        "style-src 'self'",
        "img-src 'self'",
        "connect-src 'self'",
        "base-uri 'none'",
        "form-action 'none'",
        "frame-ancestors 'none'",
        "require-trusted-types-for 'script'",
        "trusted-types 'none'",
    )
)
_HEADERS = {
    "content-security-policy": _POLICY,
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "permissions-policy": "camera=(), geolocation=(), microphone=()",
    "referrer-policy": "no-referrer",
    "x-content-type-options": "nosniff",
}


class KeptTokens(BaseModel):
    """Which tokens one robot sent last."""

    number: int
    episode: int
    step: int
    instruction: str
    coding: str
    model: str
    grid: list[int]
    num_tokens: int
    positions: list[int] | None


@cache
def assets() -> dict[str, str]:
    """The page's files by the path under which they are served. They hold nothing secret."""
    names = sorted(entry.name for entry in (files("comvla_server") / "page").iterdir())
    served = {f"/page/{name}": name for name in names if _type(name) and name != "index.html"}
    return {"/": "index.html", **served}


def add_page(app: FastAPI, fleet: Fleet, feed: FleetFeed) -> None:
    """Adds the page and what it asks for to the admin surface.

    Args:
        app: the admin surface.
        fleet: for the tokens of one robot.
        feed: for everything else.
    """
    for path, name in assets().items():
        app.add_api_route(path, _server_of(name), methods=["GET"], include_in_schema=False)

    @app.get(
        "/events",
        summary="What happens in the fleet, as server-sent events",
        response_class=EventStream,
        status_code=200,  # the class does not say, and the description of the API asks
        responses={503: {"description": "as many pages watch as may"}},
    )
    async def events(request: Request) -> Response:
        if request.headers.get("sec-fetch-site", "same-origin") not in ("same-origin", "none"):
            raise HTTPException(403, "expected the server's own page, got one of another origin")
        try:
            return EventStream(feed, feed.join())
        except TooManyWatchersError as error:
            raise HTTPException(503, str(error), {"retry-after": "10"}) from error

    @app.get("/v1/fleet/tokens", summary="Which tokens a robot sent last")
    async def kept_tokens(robot: int) -> KeptTokens:
        known = fleet.robot(robot)
        if known is None or known.model is None:
            raise HTTPException(404, "expected the number of a robot that was seen lately")
        return KeptTokens(
            number=known.number,
            episode=known.episode,
            step=known.step,
            instruction=known.instruction,
            coding=known.coding,
            model=known.model.name,
            grid=list(known.model.grid),
            num_tokens=known.model.num_tokens,
            positions=None if known.positions is None else known.positions.tolist(),
        )


class EventStream(Response):
    """Events until the page leaves, does not keep up, or is no longer let in."""

    media_type = "text/event-stream"

    def __init__(self, feed: FleetFeed, watcher: Watcher) -> None:
        super().__init__(headers={"cache-control": "no-store", **_HEADERS})
        del self.headers["content-length"]
        self._feed = feed
        self._watcher = watcher

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        """Sends until it is over; every message waits until the one before has left."""
        watcher, admitted = self._watcher, scope.get(ADMITTED, lambda: True)
        leaving = asyncio.create_task(_when_gone(receive, watcher))
        try:
            head = {"type": "http.response.start", "status": 200, "headers": self.raw_headers}
            await send(head)
            while (event := await watcher.next()) is not None and admitted():
                await send({"type": "http.response.body", "body": event, "more_body": True})
            await send({"type": "http.response.body", "body": b"", "more_body": False})
        finally:
            leaving.cancel()
            self._feed.part(watcher)


async def _when_gone(receive: Any, watcher: Watcher) -> None:
    while (await receive())["type"] != "http.disconnect":
        pass
    watcher.drop()


def _server_of(name: str) -> Callable[[Request], Any]:
    async def serve(request: Request) -> Response:
        content, tag = _content(name)
        headers = {"cache-control": "no-cache", "etag": tag, **_HEADERS}
        if request.headers.get("if-none-match") == tag:
            return Response(status_code=304, headers=headers)
        return Response(content, media_type=_type(name), headers=headers)

    return serve


@cache
def _content(name: str) -> tuple[bytes, str]:
    content = (files("comvla_server") / "page" / name).read_bytes()
    return content, f'"{hashlib.sha256(content).hexdigest()[:32]}"'


def _type(name: str) -> str | None:
    return _TYPES.get(name[name.rfind(".") :])
