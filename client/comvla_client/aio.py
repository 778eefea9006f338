"""The asyncio form of the client: the same core, so the same answers on the same input."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Sequence
from types import TracebackType

from comvla.model_info import ModelInfo
from comvla_client import channel
from comvla_client.access import TlsOptions, Token, check_unused
from comvla_client.budget import PAPER_LINK, LinkProfile
from comvla_client.core import ClientCore
from comvla_client.edge import EdgeModel
from comvla_client.errors import ClientClosedError, TransportError
from comvla_client.observation import Observation
from comvla_client.prepared import Prepared
from comvla_client.queue import Actions
from comvla_client.reaching import make_aio_transport
from comvla_client.report import ActionChunk
from comvla_client.selection import Selector
from comvla_client.sending import SendingPolicy
from comvla_client.sizing import Budget
from comvla_client.snr import SnrInput, SnrReading
from comvla_client.tracing import Tracing, traced
from comvla_client.transport_aio import AsyncTransport
from comvla_client.uplink import UplinkForm


class AsyncComVLAClient:
    """:class:`comvla_client.ComVLAClient` for an event loop.

    Arguments, behaviour and errors are those of the synchronous client. The handshake happens in
    ``async with``, or in an explicit :meth:`connect`. The edge half runs in a worker thread, so the
    loop stays free while the cameras are encoded.
    """

    def __init__(
        self,
        target: str | AsyncTransport,
        *,
        edge: EdgeModel | ModelInfo | None = None,
        link: LinkProfile = PAPER_LINK,
        quantization: str = "int8",
        selector: str | Selector = "hard_voting",
        uplink: str | UplinkForm | None = None,
        budget: Budget = "paper",
        sending: str | SendingPolicy = "paper",
        snr: SnrInput | None = None,
        deadline_s: float | None = None,
        min_tokens: int = 1,
        execute: int | None = None,
        hold: Sequence[float] | None = None,
        session_id: str | None = None,
        seed: int = 0,
        connect_timeout_s: float = 5.0,
        tls: TlsOptions | None = None,
        token: Token | None = None,
        insecure: bool = False,
        model: str = "",
        tracing: Tracing | None = None,
    ) -> None:
        self._core = ClientCore(
            edge,
            link=link,
            quantization=quantization,
            selector=selector,
            uplink=uplink,
            budget=budget,
            sending=sending,
            snr=snr,
            deadline_s=deadline_s,
            min_tokens=min_tokens,
            execute=execute,
            hold=hold,
            session_id=session_id,
            seed=seed,
            model=model,
        )
        self._tracing = tracing
        self._connect_timeout_s = connect_timeout_s
        self._lock = asyncio.Lock()
        self._connected = False
        self._closed = False
        self._transport: AsyncTransport
        if isinstance(target, str):
            self._transport = make_aio_transport(target, tls, token, insecure=insecure, model=model)
        else:
            check_unused(tls, token, insecure)
            self._transport = target
        self._core.check_transport(self._transport)

    @property
    def info(self) -> ModelInfo:
        """The model that both halves run."""
        return self._core.info

    @property
    def deadline_s(self) -> float:
        """Longest that one step may take, in seconds."""
        return self._core.deadline_s

    @property
    def hold_action(self) -> Actions:
        """The action (A,) that the robot holds with while it has nothing else to execute."""
        held: Actions = self._core.queue.hold_action.copy()
        return held

    async def connect(self) -> None:
        """Shakes hands with the server; a second time does nothing.

        Raises:
            HandshakeError: no ComVLA server at the target in time, or one with another model.
            ClientClosedError: the client is closed.
        """
        self._check_open()
        if self._connected:
            return
        try:
            response = await self._transport.get_model(self._connect_timeout_s)
            self._core.accept_server(response)
        except TransportError as error:
            await self.close()
            target = channel.target_of(self._transport)
            raise channel.no_server(target, error, self._connect_timeout_s) from error
        except BaseException:
            await self.close()
            raise
        self._connected = True

    async def step(
        self, obs: Observation, instr: str, snr: float | SnrReading | None = None
    ) -> ActionChunk:
        """Asks for the next chunk of actions: :meth:`comvla_client.ComVLAClient.step`."""
        async with self._lock:
            return await self._step(obs, instr, snr)

    async def act(
        self, obs: Observation, instr: str, snr: float | SnrReading | None = None
    ) -> Actions:
        """The action (A,) for this control period: :meth:`comvla_client.ComVLAClient.act`."""
        async with self._lock:
            self._check_open()
            action = self._core.next_action()
            if action is None:
                await self._step(obs, instr, snr)
                action = self._core.next_action()
            assert action is not None, "every chunk has a row to execute"
            return action

    async def reset(self) -> None:
        """Begins a new episode: forgets the chunk, starts a new session at step 0."""
        async with self._lock:
            self._check_open()
            self._core.reset()

    async def close(self) -> None:
        """Ends a step under way in another task with ClientClosedError and frees the connection."""
        self._closed = True
        await self._transport.close()

    async def __aenter__(self) -> AsyncComVLAClient:
        await self.connect()
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        await self.close()

    async def _step(
        self, obs: Observation, instr: str, snr: float | SnrReading | None
    ) -> ActionChunk:
        await self.connect()
        with traced(self._tracing) as trace:
            prepared = await self._prepare(obs, instr, snr)
            trace.prepared(prepared)
            if prepared.request is None:
                chunk = self._core.fail(prepared)
            else:
                with trace.call():
                    chunk = await self._call(prepared)
            trace.done(chunk)
        return chunk

    async def _prepare(
        self, obs: Observation, instr: str, snr: float | SnrReading | None
    ) -> Prepared:
        work = asyncio.ensure_future(asyncio.to_thread(self._core.prepare, obs, instr, snr))
        try:
            return await asyncio.shield(work)
        except asyncio.CancelledError:
            # A thread cannot be cancelled, and the next step must not meet it in the edge model.
            await asyncio.wait([work])
            raise

    async def _call(self, prepared: Prepared) -> ActionChunk:
        assert prepared.request is not None
        remaining_s = prepared.remaining_s()
        if remaining_s <= 0.0:
            return self._core.fail(prepared, self._core.too_late(prepared))
        sent = time.perf_counter()
        try:
            response = await self._core.call(self._transport, prepared, remaining_s)
        except TransportError as error:
            self._check_open()
            if self._core.may_relearn(error):
                error = await self._relearn(error)
            return self._core.fail(prepared, error, time.perf_counter() - sent)
        return self._core.complete(prepared, response, time.perf_counter() - sent)

    async def _relearn(self, error: TransportError) -> TransportError:
        """Shakes hands anew with a server whose model was replaced, within another deadline."""
        try:
            return self._core.relearn(await self._transport.get_model(self._core.deadline_s))
        except TransportError:
            return error

    def _check_open(self) -> None:
        if self._closed:
            raise ClientClosedError("the client is closed: make a new one")
