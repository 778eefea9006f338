"""The admin surface: what operators, probes and Prometheus ask over HTTP. Read only;
what changes something is in :mod:`comvla_server.admin_models`."""

from __future__ import annotations

import time
from typing import Annotated

from fastapi import FastAPI, HTTPException, Query, Request, Response
from prometheus_client.exposition import choose_encoder
from pydantic import BaseModel

from comvla import codec
from comvla.model_info import PROTOCOL_VERSION
from comvla_server.fleet_feed import FleetFeed
from comvla_server.fleet_page import add_page
from comvla_server.lifecycle import Lifecycle, Phase
from comvla_server.metrics import Metrics
from comvla_server.models import Models, Runtime
from comvla_server.service import PolicyService
from comvla_server.settings import ServerSettings
from comvla_server.version import server_version


class ModelDescription(BaseModel):
    """The model that answers."""

    name: str
    fingerprint: str
    protocol_version: int
    server_version: str
    num_tokens: int
    token_dim: int
    tower_dims: list[int]
    grid: list[int]
    image_size: list[int]
    action_horizon: int
    action_dim: int
    proprio_dim: int
    max_prompt_tokens: int
    control_period_s: float
    quantizations: list[str]
    image_codings: list[str]
    run_options: list[str]
    max_request_bytes: int
    max_batch: int


class SessionDescription(BaseModel):
    """One robot's session."""

    session_id: str
    identity: str
    newest_step: int
    answers: int
    waiting: bool
    running: bool
    idle_s: float
    tokens_used: int | None


class SessionList(BaseModel):
    """Most recently seen first."""

    count: int
    sessions: list[SessionDescription]


class Readiness(BaseModel):
    """Whether calls are answered, and what the server does if not."""

    ready: bool
    phase: Phase


class Liveness(BaseModel):
    """Whether the process can still do its work."""

    status: str


def create_app(
    lifecycle: Lifecycle,
    metrics: Metrics,
    service: PolicyService,
    settings: ServerSettings,
    feed: FleetFeed,
) -> FastAPI:
    """The HTTP application. It reads objects of its own event loop, so it needs no lock.

    Args:
        lifecycle: where the server stands.
        metrics: what ``/metrics`` shows.
        service: for the model and its sessions.
        settings: limits to describe.
        feed: for the page.
    """
    app = FastAPI(
        title="ComVLA server",
        version=server_version(),
        description="Admin surface of a ComVLA policy server. Robots talk gRPC on the other port.",
        # FastAPI's pages load scripts of other hosts into the origin that holds an operator's token.
        docs_url=None,
        redoc_url=None,
    )

    def loaded() -> Runtime:
        if service.runtime is None:
            raise HTTPException(
                503, "the model is still loading: ask again when /readyz says ready"
            )
        return service.runtime

    @app.get("/healthz", summary="Liveness: restart the process when this fails")
    async def healthz(response: Response) -> Liveness:
        if lifecycle.ready and not all(r.batcher.alive for r in service.models):
            response.status_code = 503
            return Liveness(status="the dispatcher has died: restart the server")
        if lifecycle.phase is Phase.STOPPED:
            response.status_code = 503
            return Liveness(status="gRPC takes no calls any more: restart the server")
        return Liveness(status="ok")

    @app.get("/readyz", summary="Readiness: send robots here only while this is 200")
    async def readyz(response: Response) -> Readiness:
        response.status_code = 200 if lifecycle.ready else 503
        return Readiness(ready=lifecycle.ready, phase=lifecycle.phase)

    @app.get("/v1/model", summary="The model that answers")
    async def model() -> ModelDescription:
        return _describe_model(loaded(), settings)

    @app.get("/v1/sessions", summary="Robots seen lately")
    async def sessions(limit: Annotated[int, Query(ge=1, le=10_000)] = 100) -> SessionList:
        loaded()
        return _describe_sessions(service.models, limit)

    @app.get("/metrics", summary="Prometheus exposition", response_class=Response)
    async def prometheus(request: Request) -> Response:
        encode, content_type = choose_encoder(request.headers.get("accept", ""))
        return Response(encode(metrics.registry), media_type=content_type)

    add_page(app, service.fleet, feed)
    return app


def _describe_model(runtime: Runtime, settings: ServerSettings) -> ModelDescription:
    info = runtime.engine.info
    return ModelDescription(
        name=info.name,
        fingerprint=info.fingerprint,
        protocol_version=PROTOCOL_VERSION,
        server_version=server_version(),
        num_tokens=info.num_tokens,
        token_dim=info.token_dim,
        tower_dims=list(info.tower_dims),
        grid=list(info.grid),
        image_size=list(info.image_size),
        action_horizon=info.action_horizon,
        action_dim=info.action_dim,
        proprio_dim=info.proprio_dim,
        max_prompt_tokens=info.max_prompt_tokens,
        control_period_s=info.control_period_s,
        quantizations=list(codec.QUANTIZATIONS),
        image_codings=list(runtime.engine.image_codings),
        run_options=list(runtime.engine.run_options),
        max_request_bytes=settings.max_request_bytes,
        max_batch=settings.max_batch,
    )


def _describe_sessions(models: Models, limit: int) -> SessionList:
    now_s = time.monotonic()
    known = [session for runtime in models for session in runtime.batcher.sessions]
    if len(models) > 1:
        known.sort(key=lambda session: session.last_seen_s)
    return SessionList(
        count=len(known),
        sessions=[
            SessionDescription(
                session_id=session.session_id,
                identity=session.owner,
                newest_step=session.newest_step,
                answers=session.answers,
                waiting=session.queued is not None,
                running=session.running is not None,
                idle_s=max(0.0, now_s - session.last_seen_s),
                tokens_used=session.tokens_used,
            )
            for session in reversed(known[-limit:])
        ],
    )
