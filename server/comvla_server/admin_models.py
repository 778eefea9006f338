"""Admin routes that look at models and replace them; the only ones that change anything."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from fastapi import FastAPI, HTTPException, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from starlette.requests import ClientDisconnect

from comvla_server.admin_auth import MAY_SWAP, rights_of
from comvla_server.models import Models
from comvla_server.settings import ServerSettings
from comvla_server.swapping import SwapError, Swapper, Trouble

MOST_ORDER_BYTES = 16 * 1024
"""Size of an order; larger ones are refused unread."""

_STATUS: dict[Trouble, int] = {
    "unknown": 404,
    "busy": 409,
    "robots": 409,
    "checkpoint": 422,
    "memory": 507,
    "stopping": 503,
}


class ServedModel(BaseModel):
    """One model that answers."""

    model: str
    name: str
    fingerprint: str
    edge_fingerprints: list[str]
    source: str | None
    queue_depth: int
    calls: int


class ModelList(BaseModel):
    """The default first."""

    models: list[ServedModel]
    swap: str


class SwapOrder(BaseModel):
    """What to replace by what."""

    model_config = ConfigDict(extra="forbid")

    source: str = Field(min_length=1, max_length=4096)
    model: str = Field(default="", max_length=100)
    new_edge: bool = False
    check: bool = False


class SwapDone(BaseModel):
    """See :class:`comvla_server.swap_report.SwapReport`."""

    model: str
    source: str
    before: str
    after: str
    robots: str
    needed_bytes: int
    available_bytes: int | None
    swapped: bool
    load_s: float
    warm_up_s: float
    drain_s: float
    freed: bool


def add_model_routes(
    app: FastAPI,
    models: Models,
    swapper: Callable[[], Swapper | None],
    settings: ServerSettings,
) -> None:
    """Adds ``/v1/models`` and ``/v1/models/swap``.

    Args:
        app: the admin surface.
        models: what answers.
        swapper: replaces models; None while the server loads.
        settings: whether operators have tokens.
    """

    @app.get("/v1/models", summary="The models that answer, by name")
    async def served() -> ModelList:
        at_work = swapper()
        sources = {} if at_work is None else at_work.sources
        return ModelList(
            models=[
                ServedModel(
                    model=runtime.name,
                    name=runtime.engine.info.name,
                    fingerprint=runtime.engine.info.fingerprint,
                    edge_fingerprints=sorted(runtime.validator.also),
                    source=sources.get(runtime.name),
                    queue_depth=runtime.batcher.queue_depth,
                    calls=len(runtime.users),
                )
                for runtime in models
            ],
            swap="" if at_work is None else at_work.busy,
        )

    @app.post(
        "/v1/models/swap",
        summary="Replace a model while robots use it",
        responses={code: {"description": words} for code, words in _RESPONSES.items()},
        openapi_extra={
            "requestBody": {
                "required": True,
                "content": {"application/json": {"schema": SwapOrder.model_json_schema()}},
            }
        },
    )
    async def swap(request: Request) -> SwapDone:
        # FastAPI would read an order of any size before it is known who sends it.
        _check_operator(request, settings)
        order = await _order(request)
        at_work = swapper()
        if at_work is None:
            raise HTTPException(503, "the model is still loading: ask again when /readyz is 200")
        report = await at_work.swap(
            order.model, order.source, new_edge=order.new_edge, check=order.check
        )
        return SwapDone(**vars(report))

    @app.exception_handler(SwapError)
    async def refused(_: Request, error: Exception) -> JSONResponse:
        assert isinstance(error, SwapError)
        content: dict[str, Any] = {"detail": str(error), "trouble": error.trouble}
        return JSONResponse(content, _STATUS[error.trouble])


_RESPONSES = {
    403: "No operator's token",
    404: "No model of that name",
    409: "Another swap is under way, or robots could not work with that checkpoint",
    413: "More than any order takes",
    422: "A checkpoint that cannot be used, or an order that makes no sense",
    503: "The server loads or drains",
    507: "Too little memory for both models",
}


async def _order(request: Request) -> SwapOrder:
    """Reads an order.

    Raises:
        HTTPException: it is too large, or ends before its time.
        RequestValidationError: it makes no sense.
    """
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind != "application/json":
        raise HTTPException(422, f"expected Content-Type: application/json, got {kind!r}")
    content = bytearray()
    try:
        async for piece in request.stream():
            content += piece
            if len(content) > MOST_ORDER_BYTES:
                raise HTTPException(413, f"expected an order of at most {MOST_ORDER_BYTES} bytes")
    except ClientDisconnect as error:
        raise HTTPException(400, "expected a whole order, the connection was closed") from error
    try:
        return SwapOrder.model_validate_json(bytes(content))
    except ValidationError as error:
        troubles = error.errors(include_url=False, include_context=False)
        raise RequestValidationError(troubles) from error


def _check_operator(request: Request, settings: ServerSettings) -> None:
    """Lets operators past. A page that a browser of theirs happens to show is none.

    Raises:
        HTTPException: anybody else, with the remedy.
    """
    if settings.admin_tokens_file is None:
        raise HTTPException(
            403,
            "a model is replaced by operators only, and this server knows none: start it with "
            "--admin-tokens-file, and make a token with `comvla-server token new NAME --may-swap`",
        )
    scheme = request.headers.get("authorization", "").partition(" ")[0].lower()
    if scheme != "bearer" or MAY_SWAP not in rights_of(request.scope):
        raise HTTPException(
            403,
            "expected the token of an operator who may swap, as Authorization: Bearer: make one with "
            "`comvla-server token new NAME --may-swap --file FILE`",
        )
