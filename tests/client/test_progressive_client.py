"""Payloads in pieces over real sockets, to a real server, through a link that stops in the middle."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import pytest
from client_stubs import StubEdge, StubService, StubTransport, model_response, serving
from stalling_link import StallingLink
from waiting import until

from comvla import codec
from comvla.errors import HandshakeError
from comvla.v1.policy_pb2 import InferRequest
from comvla_client import AsyncComVLAClient, ComVLAClient, LinkProfile
from comvla_client.report import ActionChunk
from comvla_client.sending import Progressive
from comvla_client.streaming import BURST_PIECES, PayloadStream, paced
from comvla_server.background import BackgroundServer
from comvla_vla import CloudModel, EdgeModel

# A window that a busy machine can keep to: the link decides what arrives, not the clock.
LINK = LinkProfile(bandwidth_hz=0.88e6, period_s=0.3)
# One for steps that have to arrive whole.
WIDE = LinkProfile(bandwidth_hz=0.88e6, period_s=1.0)
WORDS = "pull the green drawer open"
TOKENS = 24
Policy = tuple[EdgeModel, CloudModel]


def observation(seed: int = 0) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    images = [rng.integers(0, 256, (128, 128, 3), dtype=np.uint8) for _ in range(2)]
    return {"images": images, "proprio": rng.standard_normal(4)}


def client_of(target: str, policy: Policy, **options: Any) -> ComVLAClient:
    options = {
        "edge": policy[0],
        "link": LINK,
        "deadline_s": 20.0,
        "budget": TOKENS,
        "sending": "progressive",
        **options,
    }
    return ComVLAClient(target, **options)


def port_of(server: BackgroundServer) -> int:
    return int(server.target.rpartition(":")[2])


def whole_bytes(client: ComVLAClient) -> int:
    """Bytes of a step that arrived whole, which a busy machine may fail to hand out in time at first."""
    reports = []

    def whole() -> bool:
        reports.append(client.step(observation(9), WORDS).report)
        return reports[-1].tokens_used == TOKENS

    until(whole)
    return int(reports[-1].framed_bytes)


def test_over_a_good_link_pieces_are_answered_as_the_whole(
    policy: Policy, server: BackgroundServer
) -> None:
    with (
        client_of(server.target, policy, link=WIDE) as client,
        client_of(server.target, policy, sending="paper") as unary,
    ):
        for seed in range(3):
            one = client.step(observation(seed), WORDS)
            other = unary.step(observation(seed), WORDS)
            np.testing.assert_array_equal(one.actions, other.actions)
            assert one.report.tokens == one.report.tokens_used == TOKENS
            assert one.report.policy == "progressive"
            np.testing.assert_array_equal(one.report.positions, other.report.positions)
            assert one.report.encoded_bytes == other.report.encoded_bytes
            assert one.report.framed_bytes > other.report.framed_bytes


def test_when_the_link_stops_the_prefix_is_answered_bit_for_bit(
    policy: Policy, server: BackgroundServer
) -> None:
    with StallingLink(port_of(server)) as link, client_of(link.target, policy) as client:
        all_bytes = whole_bytes(client)
        arrived = []
        for seed, share in enumerate((0.35, 0.6, 0.85)):
            link.stall_after(int(share * all_bytes))
            cut = client.step(observation(seed), WORDS)
            link.go_on()
            assert cut.source == "cloud"
            arrived.append(cut.report.tokens_used)
            with client_of(server.target, policy, sending="paper", budget=arrived[-1]) as unary:
                whole = unary.step(observation(seed), WORDS)
            np.testing.assert_array_equal(cut.actions, whole.actions)
            positions = cut.report.positions[: arrived[-1]]
            np.testing.assert_array_equal(positions, whole.report.positions)
        assert 0 < arrived[0] < arrived[1] < arrived[2] < TOKENS
        whole_bytes(client)  # it recovers


def test_a_link_that_stops_too_early_is_a_fallback_and_nothing_worse(
    policy: Policy, server: BackgroundServer
) -> None:
    with (
        StallingLink(port_of(server)) as link,
        client_of(link.target, policy, min_tokens=8) as client,
    ):
        link.stall_after(whole_bytes(client) // 4)
        lost = client.step(observation(1), WORDS)
        link.go_on()
        assert (lost.source, lost.report.fallback_reason) == ("hold", "deadline")
        assert "at least 8 whole tokens" in lost.report.detail
        assert lost.report.tokens_used == 0
        whole_bytes(client)  # it recovers


async def test_the_asyncio_client_sends_pieces_too(
    policy: Policy, server: BackgroundServer
) -> None:
    with client_of(server.target, policy, link=WIDE) as client:
        expected = client.step(observation(3), WORDS)
    with StallingLink(port_of(server)) as link:
        async with AsyncComVLAClient(
            link.target,
            edge=policy[0],
            link=LINK,
            deadline_s=20.0,
            budget=TOKENS,
            sending="progressive",
        ) as client_aio:

            async def whole() -> ActionChunk:
                for _ in range(20):  # a busy machine may not hand out all in time at first
                    chunk = await client_aio.step(observation(3), WORDS)
                    if chunk.report.tokens_used == TOKENS:
                        break
                assert chunk.report.tokens_used == TOKENS
                return chunk

            came = await whole()
            np.testing.assert_array_equal(came.actions, expected.actions)
            link.stall_after(came.report.framed_bytes * 2 // 3)
            cut = await client_aio.step(observation(4), WORDS)
            link.go_on()
            assert 0 < cut.report.tokens_used < TOKENS
            await whole()  # it recovers


def test_a_server_without_pieces_is_refused_in_the_handshake() -> None:
    service = StubService()
    service.model = model_response(progressive=False)
    with serving(service) as (target, _), pytest.raises(HandshakeError, match="update the server"):
        ComVLAClient(target, edge=StubEdge(), sending="progressive", budget=4)


def test_a_transport_without_pieces_is_refused_at_once() -> None:
    with pytest.raises(ValueError, match="infer_progressive"):
        ComVLAClient(StubTransport(), edge=StubEdge(), sending=Progressive())


class Clock:
    """Time that passes only where somebody waits."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


class Waiting(threading.Event):
    def __init__(self, clock: Clock) -> None:
        super().__init__()
        self._clock = clock

    def wait(self, timeout: float | None = None) -> bool:
        self._clock.now_s += timeout or 0.0
        return self.is_set()


@pytest.mark.parametrize("rate", [1e3, 1e4, 1e6, None])
def test_no_more_is_handed_out_than_the_pace_allows(rate: float | None) -> None:
    tokens = np.zeros((64, 96), np.float32)
    payload = codec.encode(tokens, np.arange(64), "int8")
    ends = codec.piece_ends(64, 96, "int8")
    clock = Clock()
    stream = PayloadStream(InferRequest(), payload, ends, 0.05, 1, rate)
    handed = []
    for message in paced(stream, 0.05, Waiting(clock), clock):
        handed.append((clock.now_s, len(message.piece)))
    times, sizes = np.array(handed)[1:].T
    assert (times <= 0.05).all()
    if rate is None:
        assert sizes.sum() == len(payload)
    else:
        burst = ends[BURST_PIECES - 1]
        before = np.concatenate([[0.0], np.cumsum(sizes)[:-1]])
        assert (before <= burst + rate * times + 1e-6).all()
    assert stream.taken == len(sizes)
    assert stream.taken_bytes == sizes.sum()
    assert stream.taken_tokens == codec.prefix_tokens(int(sizes.sum()), 96, "int8")
    assert stream.taken_wire_bytes == stream.costs()[len(sizes) - 1]


def test_what_is_told_to_stop_stops() -> None:
    clock = Clock()
    stopped = Waiting(clock)
    payload = codec.encode(np.zeros((8, 4), np.float32), np.arange(8), "int8")
    stream = PayloadStream(InferRequest(), payload, codec.piece_ends(8, 4, "int8"), 0.05, 1, 100.0)
    messages = paced(stream, 0.05, stopped, clock)
    assert next(messages).HasField("head")
    next(messages)
    stopped.set()
    assert list(messages) == []
    assert stream.taken == 1
