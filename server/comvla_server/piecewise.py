"""Collects a payload that comes piece by piece, for as long as its head says and no longer."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import AsyncIterator, Callable
from typing import Any, Literal

from comvla import codec
from comvla.errors import CodecError
from comvla.model_info import ModelInfo
from comvla.v1 import policy_pb2
from comvla_server.refusals import Reason, Refusal

MAX_WINDOW_S = 10.0
"""Longest window that a head may ask for: a stream holds a call open without any compute."""

Ending = Literal["whole", "closed", "window", "repeat", "refused"]
ENDINGS: tuple[Ending, ...] = ("whole", "closed", "window", "repeat", "refused")

_HANG_UP_S = 0.001

# The fixed part of a payload's header and up to sixteen tower widths.
_LONGEST_HEADER = 44


class PieceReader:
    """Reads one stream: its head, then pieces until there is enough, no more, or no time.

    Reads one message at a time, so that HTTP/2 holds back a robot that sends faster than this.

    Args:
        messages: parsed messages; anything that is no ``InferProgressiveRequest`` did not parse.
        on_message: called with each message before it is looked at; may raise Refusal.
        clock: monotonic seconds.

    Attributes:
        ending: how the stream ended.
        payload: what came so far.
    """

    def __init__(
        self,
        messages: AsyncIterator[Any],
        on_message: Callable[[policy_pb2.InferProgressiveRequest], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._messages = messages
        self._info: ModelInfo | None = None
        self._min_tokens = 0
        self._on_message = on_message
        self._clock = clock
        self.ending: Ending = "refused"
        self.payload = bytearray()

    async def head(self, patience_s: float) -> policy_pb2.InferProgressiveHead:
        """The first message.

        Args:
            patience_s: longest to wait for it.

        Raises:
            Refusal: none came, or it is no head.
        """
        try:
            message = await self._next(patience_s)
        except asyncio.TimeoutError:
            raise Refusal(
                Reason.DEADLINE,
                f"expected a head within {patience_s:.3f} s, none came: send it first, and at once",
            ) from None
        if message is None:
            raise _invalid("expected a head, got an empty stream: send head, then pieces")
        if message.WhichOneof("part") != "head":
            raise _invalid(
                f"expected a head as the first message, got {_part(message)}: send head, then pieces"
            )
        head: policy_pb2.InferProgressiveHead = message.head
        self._check(head)
        return head

    def expect(self, info: ModelInfo, min_tokens: int) -> None:
        """Says what the pieces are of; comes before :meth:`collect`.

        Args:
            info: the model; no payload of its tokens is larger than all of them in the widest coding.
            min_tokens: whole tokens that have to be there.

        Raises:
            Refusal: more than the model has.
        """
        if min_tokens > info.num_tokens:
            raise _invalid(
                f"expected min_tokens of at most {info.num_tokens}, got {min_tokens}: "
                "no observation has more"
            )
        self._info, self._min_tokens = info, min_tokens

    async def collect(self, window_s: float) -> bytes:
        """The payload, or as much of it as came in time.

        Args:
            window_s: seconds from now in which pieces count.

        Raises:
            Refusal: too little came, or something that is no piece of one payload.
        """
        ends_s = self._clock() + window_s
        announced: int | None = None
        while announced is None or len(self.payload) < announced:
            try:
                message = await self._next(ends_s - self._clock())
            except asyncio.TimeoutError:
                self.ending = "window"
                break
            if message is None:
                self.ending = "closed"
                # gRPC reports a robot that hung up as one that closed, and cancels right after.
                await asyncio.sleep(_HANG_UP_S)
                break
            self._append(message)
            announced = self._announced()
        else:
            self.ending = "whole"
        self._require(max(1, self._min_tokens), window_s)
        return bytes(self.payload)

    async def _next(self, patience_s: float) -> policy_pb2.InferProgressiveRequest | None:
        """The next message, None at the end of the stream, or TimeoutError."""
        if patience_s <= 0.0:
            raise asyncio.TimeoutError
        reading = asyncio.ensure_future(_next_of(self._messages))
        try:
            # Unlike wait_for, wait never takes a cancelled call for one that got its message.
            await asyncio.wait([reading], timeout=patience_s)
        finally:
            reading.cancel()
        if not reading.done():
            raise asyncio.TimeoutError
        message = reading.result()
        if message is None:
            return None
        if not isinstance(message, policy_pb2.InferProgressiveRequest):
            raise Refusal(
                Reason.MALFORMED,
                "expected comvla.v1.InferProgressiveRequest, got bytes that do not parse as one: "
                "build messages from the contract's generated code",
            )
        self._on_message(message)
        return message

    def _append(self, message: policy_pb2.InferProgressiveRequest) -> None:
        if message.WhichOneof("part") != "piece" or not message.piece:
            raise _invalid(
                f"expected a piece with at least one byte after the head, got {_part(message)}: "
                "send one head, then pieces, and close the stream"
            )
        self.payload += message.piece

    def _announced(self) -> int | None:
        """Length of the whole payload, None until its header is there.

        Raises:
            Refusal: it is not one of this model, or more came than it announces.
        """
        info, came = self._info, len(self.payload)
        assert info is not None, "expect() comes first"
        try:
            header = codec.read_header(self.payload)
        except CodecError as error:
            if came >= _LONGEST_HEADER:
                raise _invalid(f"payload: {error}") from error
            return None
        if (header.token_dim, header.tower_dims) != (info.token_dim, info.tower_dims):
            raise _invalid(
                f"payload: expected token_dim {info.token_dim} of towers {list(info.tower_dims)}, "
                f"got {header.token_dim} of {list(header.tower_dims)}: load the edge half of the "
                "same checkpoint"
            )
        if not 1 <= header.count <= info.num_tokens:
            raise _invalid(
                f"payload: expected 1 to {info.num_tokens} tokens, got {header.count}: "
                "where there is none to send, act on the rest of the last chunk"
            )
        whole = codec.encoded_bytes(
            header.count,
            header.token_dim,
            header.quantization,
            num_towers=len(header.tower_dims),
        )
        if came > whole:
            raise _invalid(
                f"payload: expected {whole} bytes for the {header.count} tokens that it announces, "
                f"got {came}: close the stream after the last token"
            )
        return whole

    def _check(self, head: policy_pb2.InferProgressiveHead) -> None:
        window_s = head.window_s
        if not (math.isfinite(window_s) and 0.0 < window_s <= MAX_WINDOW_S):
            raise _invalid(
                f"expected a window_s above 0 and at most {MAX_WINDOW_S:g} seconds, got "
                f"{window_s}: it is the time that the payload has to cross"
            )
        if head.request.payload:
            raise _invalid(
                f"expected a head without payload, got one with {len(head.request.payload)} bytes: "
                "send them as pieces, or use Infer"
            )

    def _require(self, least: int, window_s: float) -> None:
        came = len(self.payload)
        tokens = 0
        if came >= _LONGEST_HEADER or self._announced() is not None:
            header = codec.read_header(self.payload)
            tokens = codec.prefix_tokens(
                came,
                header.token_dim,
                header.quantization,
                num_towers=len(header.tower_dims),
            )
        if tokens < least:
            within = (
                f"within {window_s:.3f} s"
                if self.ending == "window"
                else "before the robot closed the stream"
            )
            raise Refusal(
                Reason.SHORT,
                f"expected at least {least} whole tokens {within}, got {tokens} in {came} bytes: "
                "act on the rest of the last chunk, or allow a longer window or fewer tokens",
            )


async def _next_of(messages: AsyncIterator[Any]) -> Any:
    return await anext(messages, None)


def _part(message: policy_pb2.InferProgressiveRequest) -> str:
    part = message.WhichOneof("part")
    return {"head": "a second head", "piece": "a piece", None: "neither head nor piece"}[part]


def _invalid(message: str) -> Refusal:
    return Refusal(Reason.INVALID, message)
