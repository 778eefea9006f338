"""Calls to several servers that answer alike, in turns; who fails is left out until it is well again.

A step stands alone, so any server can answer it, and a repeat of it as well. Where one says that it
cannot (it is gone, drains, runs another model, is busy), the next is asked at once. Where one is
silent for much longer than usual, it is asked over a new connection whether it is well, and two others
too: if another says so and it does not, the step is sent to that one as well, and the first answer
counts. Only then is a payload sent twice: where the link is what is slow, both would only make it slower.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures import TimeoutError as FutureTimeoutError
from contextvars import copy_context
from functools import partial
from typing import Any, TypeAlias

from comvla.v1.policy_pb2 import GetModelResponse, InferRequest, InferResponse
from comvla_client import channel
from comvla_client.access import TlsOptions, Token
from comvla_client.errors import ClientClosedError, TransportError
from comvla_client.line import Line
from comvla_client.look_up import LookUps
from comvla_client.revival import PATIENCE_S
from comvla_client.roster import (
    LOOK_UP_DOWN_EVERY_S,
    LOOK_UP_EVERY_S,
    LOOK_UP_NOBODY_EVERY_S,
    PROBE_EVERY_S,
    PROBE_TIMEOUT_S,
    Member,
    Roster,
)
from comvla_client.search import Search
from comvla_client.streaming import PayloadStream
from comvla_client.targets import Address, Addresses
from comvla_client.transport import GrpcTransport

Work: TypeAlias = Callable[[GrpcTransport, float], Any]
"""Makes a call over a transport within so many seconds."""

_Member: TypeAlias = "Member[Line]"


class FleetTransport:
    """:class:`comvla_client.transport.GrpcTransport` to several servers.

    Args:
        target: ``host:port`` or ``dns:///name:port``, once or more with commas between.
        tls, token, insecure, model: as for one server.

    Raises:
        HandshakeError: a part of the target is no address.
        AccessError: certificates or a token that cannot be used; of servers that a name stands for,
            from the first call that knows them.
    """

    def __init__(
        self,
        target: str,
        tls: TlsOptions | None = None,
        token: Token | None = None,
        *,
        insecure: bool = False,
        model: str = "",
    ) -> None:
        self.target = target
        addresses = Addresses(target)
        self._names = LookUps(addresses)
        self._closed = threading.Event()
        self._lock = threading.Lock()
        self._prober: threading.Thread | None = None

        def make(address: Address) -> Line:
            named = None if tls is None else tls.with_server_name(address.server_name)
            return Line(
                GrpcTransport(
                    address.target, named, token, insecure=insecure, model=model, patient=False
                )
            )

        self._roster: Roster[Line] = Roster(make)
        self._roster.update(addresses.fixed)

    def get_model(self, timeout_s: float) -> GetModelResponse:
        """The description that the first server gives which is there.

        Raises:
            TransportError: no usable answer within ``timeout_s`` seconds.
            ClientClosedError: the transport is closed.
        """
        answer: GetModelResponse = self._call(lambda one, left_s: one.get_model(left_s), timeout_s)
        return answer

    def infer(self, request: InferRequest, timeout_s: float) -> InferResponse:
        """Actions for one observation, from whoever answers first.

        Raises:
            TransportError: no usable answer within ``timeout_s`` seconds.
            ClientClosedError: the transport is closed, before or during the call.
        """
        answer: InferResponse = self._call(
            lambda one, left_s: one.infer(request, left_s), timeout_s
        )
        return answer

    def infer_progressive(self, stream: PayloadStream, timeout_s: float) -> InferResponse:
        """Actions for as much of one observation as arrives within the stream's window.

        Raises:
            TransportError: no usable answer within ``timeout_s`` seconds.
            ClientClosedError: the transport is closed, before or during the call.
        """
        answer: InferResponse = self._call(
            lambda one, left_s: one.infer_progressive(stream, left_s), timeout_s
        )
        return answer

    def close(self) -> None:
        """Ends calls under way with ClientClosedError. Closing twice does no harm."""
        self._closed.set()
        for member in self._roster.members:
            member.transport.close()

    def _call(self, work: Work, timeout_s: float) -> Any:
        search = Search(self._roster, self.target, timeout_s)
        self._check_open()
        self._look_up(LOOK_UP_EVERY_S)
        while True:
            self._check_open()
            member = search.next()
            if member is None:
                # Everybody was asked once; those who are merely away may be back.
                if self._closed.wait(search.pause_s()):
                    raise self._closed_error()
                self._look_up(LOOK_UP_NOBODY_EVERY_S)
                continue
            try:
                return self._ask(member, work, search.remaining_s(), search.tried)
            except TransportError as error:
                search.failed(member, error)

    def _ask(self, member: _Member, work: Work, timeout_s: float, tried: list[_Member]) -> Any:
        """One server's answer, or another's where it is silent."""
        deadline = time.monotonic() + timeout_s
        first = self._send(member, work, timeout_s)
        try:
            return first.result(min(timeout_s, member.patience_s))
        except FutureTimeoutError:
            pass
        except TransportError as error:
            self._note(member, error)
            raise
        other = self._somebody_else(member, first, deadline, tried)
        calls = {first: member}
        if other is not None and (left_s := deadline - time.monotonic()) > 0.0:
            self._roster.leave(member)
            self._look_after()
            calls[self._send(other, work, left_s)] = other
        return self._first_answer(calls, deadline, timeout_s)

    def _first_answer(
        self, calls: dict[Future[Any], _Member], deadline: float, timeout_s: float
    ) -> Any:
        pending, failure = set(calls), channel.unanswered(timeout_s)
        while pending:
            left_s = max(0.0, deadline - time.monotonic())
            done, pending = wait(pending, left_s, return_when=FIRST_COMPLETED)
            if not done:
                break
            for call in done:
                try:
                    return call.result()
                except TransportError as error:
                    self._note(calls[call], error)
                    failure = error
        self._check_open()
        raise failure

    def _somebody_else(
        self, silent: _Member, call: Future[Any], deadline: float, tried: list[_Member]
    ) -> _Member | None:
        """Who says that it is well while a server that owes an answer does not; None where that one does."""
        others = self._roster.others(silent, tried)
        if not others:
            return None
        news: queue.SimpleQueue[_Member | None] = queue.SimpleQueue()
        call.add_done_callback(lambda _: news.put(None))
        for member in (silent, *others):
            threading.Thread(
                target=lambda one=member: news.put(one) if one.transport.is_well() else None,
                name="comvla-probe",
                daemon=True,
            ).start()
        # The one that is silent is heard first for as long as a ping may take.
        choice, ends = None, min(deadline, time.monotonic() + PROBE_TIMEOUT_S)
        grace = time.monotonic() + PATIENCE_S
        while (left_s := (ends if choice is None else min(ends, grace)) - time.monotonic()) > 0.0:
            try:
                well = news.get(timeout=left_s)
            except queue.Empty:
                break
            if well is None or well is silent:
                return None
            choice = choice or well
        return choice

    def _send(self, member: _Member, work: Work, timeout_s: float) -> Future[Any]:
        context = copy_context()
        self._roster.begin(member)
        began = time.monotonic()

        def call() -> Any:
            try:
                answer = context.run(work, member.transport.transport, timeout_s)
            except ClientClosedError as error:
                self._check_open()
                raise TransportError("UNAVAILABLE", "the server's name means it no more") from error
            finally:
                self._roster.end(member)
            self._roster.answered(member, time.monotonic() - began)
            return answer

        return member.transport.submit(call)

    def _note(self, member: _Member, error: TransportError) -> None:
        self._roster.failed(member, error)
        if member.down:
            self._look_after()

    def _look_up(self, every_s: float) -> None:
        """Takes over what was found meanwhile, and has names looked up again after so many seconds."""
        for gone in self._roster.update(self._names.news(every_s)):
            gone.transport.close()

    def _look_after(self) -> None:
        """Asks servers that are down whether they are well again, in a thread, until all are."""
        with self._lock:
            if self._closed.is_set() or (self._prober is not None and self._prober.is_alive()):
                return
            self._prober = threading.Thread(target=self._probe, name="comvla-fleet", daemon=True)
            self._prober.start()

    def _probe(self) -> None:
        while True:
            self._look_up(LOOK_UP_DOWN_EVERY_S)
            for member in self._roster.to_probe():
                answer = member.transport.submit(member.transport.is_well)
                answer.add_done_callback(partial(self._probed, member))
            with self._lock:
                if not self._roster.down:
                    self._prober = None
                    return
            if self._closed.wait(PROBE_EVERY_S):
                return

    def _probed(self, member: _Member, answer: Future[bool]) -> None:
        self._roster.probed(member, answer.exception() is None and answer.result())

    def _check_open(self) -> None:
        if self._closed.is_set():
            raise self._closed_error()

    def _closed_error(self) -> ClientClosedError:
        return ClientClosedError(f"the connection to {self.target} was closed: make a new client")
