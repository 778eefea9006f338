"""The robot's client: one call a step, actions back, whatever the link does."""

from __future__ import annotations

import threading
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
from comvla_client.reaching import make_transport
from comvla_client.report import ActionChunk
from comvla_client.selection import Selector
from comvla_client.sending import SendingPolicy
from comvla_client.sizing import Budget
from comvla_client.snr import SnrInput, SnrReading
from comvla_client.tracing import Tracing, traced
from comvla_client.transport_protocol import Transport
from comvla_client.uplink import UplinkForm


class ComVLAClient:
    """Drives a robot through a policy server over a link that may be thin, late or gone.

    The constructor shakes hands with the server and refuses a foreign model before the robot moves.
    After that no state of the link or the server raises: a step without an answer gives the rest of
    the last chunk, then holds, and recovers by itself. What raises is a mistake in the program: an
    observation or instruction that does not fit, an SNR that is no number, a server that was
    replaced by one with another model.

    One client is one robot: steps of several threads run one after another. ``close`` may be called
    from any thread at any time.

    Args:
        target: ``host:port`` of a server; several that answer alike, with commas between, or a name
            that stands for them, ``dns:///name:port``; or a transport of your own, which the client
            then owns.
        edge: the robot's half of the model, e.g. ``comvla_vla.load_edge("mini")``. A robot that sends
            pictures needs none: a ``ModelInfo`` of the model that it expects, or None to take the
            server's word for it.
        link: bandwidth, period and efficiency of the radio link.
        quantization: how token values are coded: float32, float16, int8 or int4.
        selector: ranking of tokens, by name (:data:`comvla_client.registry.SELECTORS`) or your own.
        uplink: what goes up the link. Default: tokens, by ``selector``. By name a picture coding, with
            its quality or without ("jpeg-75", "jpeg", "webp-50", "avif-50", "h264"), or your own.
        budget: ``"paper"`` sizes payloads by Eq. (4), ``"framed"`` by all bytes that cross the wire;
            a number sends that many tokens (bytes of pictures) whatever the SNR.
        sending: how much is sent when, by name (:data:`comvla_client.sending.POLICIES`) or an object
            of your own: ``"paper"`` takes the reported SNR at its word, ``"margin"`` sends what very
            likely fits, given the report's age, ``"progressive"`` sends the most important tokens
            first until the window ends, ``"floor"`` sends nothing where it would be too little.
        snr: where the SNR in dB comes from when ``step`` is not told: a number, a function, or an
            object with ``read()``.
        deadline_s: longest that one ``step`` may take, edge half included, in seconds. Default: the
            time in which the robot executes a chunk (``execute`` control periods of the model); a
            later answer would be about a scene that the robot has left.
        min_tokens: fewest tokens worth sending; below it a step counts as without a link.
        execute: rows of each chunk that the robot executes before it asks again; default all H.
        hold: (A,) action to hold with. Default: the last action with its velocities and deltas set
            to zero, so that grippers keep their grip; all zeros before the first answer.
        session_id: a name for this robot in the server's view; a random part is added.
        seed: for selectors that draw; the same seed draws the same at each step of each episode.
        connect_timeout_s: longest that the constructor waits for a server, in seconds.
        tls: encrypts the link: whom to trust, and the robot's own certificate for mutual TLS. None
            sends everything in the clear.
        token: says who calls, where the server asks: text, or a path or function that is asked at
            every call, so that it can be renewed while the robot runs.
        insecure: lets a token cross a network in the clear, e.g. inside a tunnel.
        warm_up: sends filler, as much as the last request, shortly before a query that follows a
            silence: where the machine's TCP cannot be tuned, the query then takes one round trip
            instead of three, for twice the bytes (:mod:`comvla_client.warm_up`).
        model: name of the model to ask for, where the server has several; empty for its default. A
            transport of your own has to ask for the same in ``get_model``.
        tracing: OpenTelemetry traces of every step (:class:`comvla_client.tracing.Tracing`); stays
            yours to close.

    Raises:
        HandshakeError: no ComVLA server at the target in time, one with another model, or one that
            does not let this robot in.
        AccessError: certificates or a token that cannot be used.
        ValueError: an option out of range.
    """

    def __init__(
        self,
        target: str | Transport,
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
        warm_up: bool = False,
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
        self._lock = threading.RLock()
        self._closed = False
        self._transport: Transport
        if isinstance(target, str):
            self._transport = make_transport(
                target, tls, token, insecure=insecure, warm_up=warm_up, model=model
            )
        else:
            check_unused(tls, token, insecure)
            if warm_up:
                raise ValueError("warm_up belongs to a target host:port: give it to your transport")
            self._transport = target
        try:
            self._core.check_transport(self._transport)
            self._shake_hands(connect_timeout_s)
        except BaseException:
            self.close()
            raise

    @property
    def info(self) -> ModelInfo:
        """The model that both halves run."""
        return self._core.info

    @property
    def filler_bytes(self) -> int:
        """Bytes of filler that ``warm_up`` has sent so far, with their frames; in no step's report."""
        return int(getattr(self._transport, "filler_bytes", 0))

    @property
    def deadline_s(self) -> float:
        """Longest that one step may take, in seconds."""
        return self._core.deadline_s

    @property
    def hold_action(self) -> Actions:
        """The action (A,) that the robot holds with while it has nothing else to execute."""
        held: Actions = self._core.queue.hold_action.copy()
        return held

    def step(
        self, obs: Observation, instr: str, snr: float | SnrReading | None = None
    ) -> ActionChunk:
        """Asks for the next chunk of actions.

        Args:
            obs: ``images``: list of uint8 (H, W, 3) RGB in the model's view order; ``proprio``:
                float (P,), raw.
            instr: what the robot shall do.
            snr: SNR of the link now, in dB (−inf: no link), or a reading with its age; None asks
                the source that the client was made with.

        Returns:
            Actions (H, A), and the report of how they came about. Within ``deadline_s``.

        Raises:
            ObservationError, InstructionError, LinkError: input that cannot be used; nothing was sent.
            HandshakeError: the server now runs another model.
            ClientClosedError: the client is closed, before or during the step.
        """
        with self._lock:
            self._check_open()
            with traced(self._tracing) as trace:
                prepared = self._core.prepare(obs, instr, snr)
                trace.prepared(prepared)
                if prepared.request is None:
                    chunk = self._core.fail(prepared)
                else:
                    with trace.call():
                        chunk = self._call(prepared)
                trace.done(chunk)
            return chunk

    def act(self, obs: Observation, instr: str, snr: float | SnrReading | None = None) -> Actions:
        """The action for this control period: the next of the chunk, or of a new one.

        Args:
            obs: as for :meth:`step`; looked at only when the chunk is used up.
            instr: as for :meth:`step`.
            snr: as for :meth:`step`.

        Returns:
            (A,) float32.

        Raises:
            What :meth:`step` raises.
        """
        with self._lock:
            self._check_open()
            action = self._core.next_action()
            if action is None:
                self.step(obs, instr, snr)
                action = self._core.next_action()
            assert action is not None, "every chunk has a row to execute"
            return action

    def reset(self) -> None:
        """Begins a new episode: forgets the chunk, starts a new session at step 0."""
        with self._lock:
            self._check_open()
            self._core.reset()

    def close(self) -> None:
        """Ends a step under way in another thread with ClientClosedError and frees the connection."""
        # Without the lock, which that step holds.
        self._closed = True
        self._transport.close()

    def __enter__(self) -> ComVLAClient:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _shake_hands(self, connect_timeout_s: float) -> None:
        try:
            response = self._transport.get_model(connect_timeout_s)
        except TransportError as error:
            target = channel.target_of(self._transport)
            raise channel.no_server(target, error, connect_timeout_s) from error
        self._core.accept_server(response)

    def _call(self, prepared: Prepared) -> ActionChunk:
        assert prepared.request is not None
        remaining_s = prepared.remaining_s()
        if remaining_s <= 0.0:
            return self._core.fail(prepared, self._core.too_late(prepared))
        sent = time.perf_counter()
        try:
            response = self._core.call(self._transport, prepared, remaining_s)
        except TransportError as error:
            self._check_open()
            if self._core.may_relearn(error):
                error = self._relearn(error)
            return self._core.fail(prepared, error, time.perf_counter() - sent)
        return self._core.complete(prepared, response, time.perf_counter() - sent)

    def _relearn(self, error: TransportError) -> TransportError:
        """Shakes hands anew with a server whose model was replaced, within another deadline."""
        try:
            return self._core.relearn(self._transport.get_model(self._core.deadline_s))
        except TransportError:
            return error

    def _check_open(self) -> None:
        if self._closed:
            raise ClientClosedError("the client is closed: make a new one")
