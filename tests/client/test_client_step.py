"""One step: what is sent, what is reported, and what a bad link does to it."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
import torch
from client_stubs import (
    INFO,
    NARROW,
    WORDS,
    StubEdge,
    StubTransport,
    answer,
    chunk_of,
    fault,
    observation,
)

from comvla import codec
from comvla.errors import CodecError, HandshakeError, InstructionError, LinkError, ObservationError
from comvla.v1.policy_pb2 import InferRequest, InferResponse
from comvla_client import (
    ClientClosedError,
    ComVLAClient,
    SnrReading,
    framed_token_budget,
    token_budget,
)
from comvla_client.core import WIND_UP_S
from comvla_client.report import PHASES
from comvla_client.snr import ConstantSnr

OBS = observation()


def client_of(transport: StubTransport, **options: Any) -> ComVLAClient:
    # Where a test is not about time, a deadline that a busy machine can keep.
    defaults: dict[str, Any] = {"edge": StubEdge(), "link": NARROW, "deadline_s": 20.0}
    return ComVLAClient(transport, **{**defaults, **options})


def test_a_step_sends_the_budget_and_returns_the_chunk() -> None:
    transport = StubTransport()
    with client_of(transport) as client:
        chunk = client.step(OBS, WORDS, 10.0)
    request, report = transport.requests[0], chunk.report
    k = token_budget(10.0, NARROW, 12 * 8)
    tokens, positions = codec.decode(request.payload)
    assert len(positions) == k == report.tokens == report.token_budget == report.tokens_used == 18
    np.testing.assert_array_equal(chunk.actions, chunk_of(request))
    assert chunk.actions.dtype == np.float32
    assert (chunk.source, chunk.planned) == ("cloud", 8)
    assert report.fallback_reason is None
    np.testing.assert_array_equal(positions, report.positions)
    expected = StubEdge().encode(OBS["images"])[positions]
    np.testing.assert_allclose(tokens, expected, atol=np.abs(expected).max() / 127)


def test_the_request_says_all_that_the_contract_asks_for() -> None:
    transport = StubTransport()
    with client_of(transport, session_id="arm-7") as client:
        client.step(OBS, WORDS, SnrReading(10.0, age_s=0.5))
        client.step(OBS, WORDS, 10.0)
    first, second = transport.requests
    assert first.session_id == second.session_id
    assert first.session_id.startswith("arm-7.")
    assert (first.step, second.step) == (0, 1)
    assert first.instruction == WORDS
    np.testing.assert_allclose(first.proprio, OBS["proprio"], rtol=1e-6)
    assert first.model_fingerprint == INFO.fingerprint
    assert first.protocol_version == 1
    assert (first.snr_db, first.snr_age_s) == (10.0, 0.5)


def test_the_report_accounts_for_bytes_time_and_operations() -> None:
    transport = StubTransport()
    with client_of(transport) as client:
        report = client.step(OBS, WORDS, 10.0).report
    request = transport.requests[0]
    assert report.capacity_bits == NARROW.capacity_bits(10.0)
    assert report.payload_bytes == codec.payload_bytes(18, 12, "int8") == 18 * 12
    assert report.encoded_bytes == len(request.payload)
    assert report.framed_bytes == codec.wire_bytes(request.ByteSize())
    assert tuple(report.timings_s) == PHASES
    assert all(report.timings_s[phase] > 0.0 for phase in PHASES)
    parts = sum(seconds for phase, seconds in report.timings_s.items() if phase != "total")
    assert parts <= report.timings_s["total"]
    assert report.server_timings_s == {
        "decode": 0.001,
        "queue": 0.002,
        "predict": 0.003,
        "total": 0.006,
    }
    assert report.batch_size == 3
    assert (report.edge_flops, report.cloud_flops) == (1004.0, 5e9)
    assert report.load is not None
    assert (report.load.queue_depth, report.load.suggested_tokens) == (1, 0)


def test_the_report_is_json() -> None:
    with client_of(StubTransport()) as client:
        for snr in (10.0, -math.inf):
            report = client.step(OBS, WORDS, snr).report
            plain = json.loads(json.dumps(report.to_dict(), allow_nan=False))
            assert plain["tokens"] == report.tokens == len(plain["positions"])
            assert plain["snr_db"] == (10.0 if snr == 10.0 else "-inf")


@pytest.mark.parametrize("quantization", codec.QUANTIZATIONS)
def test_coarser_values_leave_room_for_more_tokens(quantization: str) -> None:
    with client_of(StubTransport(), quantization=quantization) as client:
        report = client.step(OBS, WORDS, 0.0).report
    bits = codec.bits_per_value(quantization)
    assert report.tokens == token_budget(0.0, NARROW, 12 * bits)
    assert report.payload_bytes == codec.payload_bytes(report.tokens, 12, quantization)


def test_a_framed_budget_keeps_every_byte_within_the_capacity() -> None:
    transport = StubTransport()
    with client_of(transport, budget="framed", session_id="arm") as client:
        reports = [client.step(OBS, WORDS, snr).report for snr in (0.0, 10.0, 20.0, 40.0)]
    sent = [report for report in reports if report.tokens]
    assert len(sent) >= 2
    for report in sent:
        assert report.capacity_bits is not None
        assert 8 * report.framed_bytes <= report.capacity_bits
    expected = framed_token_budget(
        20.0,
        NARROW,
        token_dim=12,
        quantization="int8",
        num_towers=2,
        session_id=reports[2].session,
        step=2,
        instruction=WORDS,
        proprio_dim=3,
        model_fingerprint=INFO.fingerprint,
    )
    assert reports[2].token_budget == expected


def test_no_more_than_the_tokens_there_are() -> None:
    with client_of(StubTransport()) as client:
        report = client.step(OBS, WORDS, 60.0).report
    assert report.token_budget > report.tokens == 32


def test_a_fixed_budget_needs_no_snr() -> None:
    transport = StubTransport()
    with client_of(transport, budget=5) as client:
        report = client.step(OBS, WORDS).report
        assert (report.tokens, report.snr_db, report.capacity_bits) == (5, None, None)
        assert not transport.requests[0].HasField("snr_db")
        assert client.step(OBS, WORDS, -40.0).report.tokens == 5
        assert client.step(OBS, WORDS, -math.inf).report.fallback_reason == "no_link"


def test_full_transmission_sends_all_whatever_the_link_carries() -> None:
    edge = StubEdge()
    with client_of(StubTransport(), selector="full", edge=edge) as client:
        assert client.step(OBS, WORDS, 0.0).report.positions.tolist() == list(range(32))
        assert client.step(OBS, WORDS).report.tokens == 32
        assert client.step(OBS, WORDS, -math.inf).report.tokens == 0
    assert "project" not in edge.calls


@pytest.mark.parametrize("selector", ["hard_voting", "soft_voting", "random"])
def test_fewer_tokens_are_the_beginning_of_more(selector: str) -> None:
    with (
        client_of(StubTransport(), selector=selector, budget=20) as many,
        client_of(StubTransport(), selector=selector, budget=6) as few,
    ):
        most = many.step(OBS, WORDS).report.positions
        least = few.step(OBS, WORDS).report.positions
    assert least.tolist() == most[:6].tolist()


def random_positions(seed: int) -> list[list[list[int]]]:
    with client_of(StubTransport(), selector="random", budget=6, seed=seed) as client:
        episodes = []
        for _ in range(2):
            episodes.append([client.step(OBS, WORDS).report.positions.tolist() for _ in range(3)])
            client.reset()
    return episodes


def test_random_selection_repeats_with_its_seed_and_changes_with_step_and_episode() -> None:
    first, again, other = random_positions(1), random_positions(1), random_positions(2)
    assert first == again != other
    drawn = [tuple(step) for episode in first for step in episode]
    assert len(set(drawn)) == len(drawn)


@pytest.mark.parametrize("snr", [math.nan, math.inf])
def test_an_snr_that_no_link_has_raises_before_anything_is_sent(snr: float) -> None:
    edge, transport = StubEdge(), StubTransport()
    with client_of(transport, edge=edge) as client, pytest.raises(LinkError):
        client.step(OBS, WORDS, snr)
    assert transport.requests == []
    assert "encode" not in edge.calls


def test_a_budget_by_snr_needs_an_snr() -> None:
    with client_of(StubTransport()) as client, pytest.raises(LinkError, match="budget=K"):
        client.step(OBS, WORDS)


def test_the_snr_comes_from_the_source_unless_told() -> None:
    values = iter([0.0, SnrReading(10.0, age_s=0.25)])
    with client_of(StubTransport(), snr=lambda: next(values)) as client:
        assert client.step(OBS, WORDS).report.snr_db == 0.0
        assert client.step(OBS, WORDS, 5.0).report.snr_db == 5.0
        report = client.step(OBS, WORDS).report
        assert (report.snr_db, report.snr_age_s) == (10.0, 0.25)
    for constant in (7.0, ConstantSnr(7.0)):
        with client_of(StubTransport(), snr=constant) as client:
            assert client.step(OBS, WORDS).report.snr_db == 7.0


@pytest.mark.parametrize("age_s", [-1.0, math.nan, math.inf])
def test_a_reading_has_a_sensible_age(age_s: float) -> None:
    with pytest.raises(LinkError, match="age"):
        SnrReading(3.0, age_s=age_s)


@pytest.mark.parametrize("snr", [-math.inf, -40.0])
def test_without_a_link_nothing_is_computed_or_sent(snr: float) -> None:
    edge, transport = StubEdge(), StubTransport()
    with client_of(transport, edge=edge) as client:
        chunk = client.step(OBS, WORDS, snr)
    report = chunk.report
    assert (report.source, report.fallback_reason, report.token_budget) == ("hold", "no_link", 0)
    assert (report.tokens, report.framed_bytes, report.edge_flops) == (0, 0, 0.0)
    assert transport.requests == []
    assert "encode" not in edge.calls


def test_too_few_tokens_are_not_worth_sending() -> None:
    transport = StubTransport()
    with client_of(transport, min_tokens=19) as client:
        report = client.step(OBS, WORDS, 10.0).report
    assert (report.token_budget, report.tokens, report.fallback_reason) == (18, 0, "no_link")
    assert transport.requests == []


FALLBACKS = {
    "UNAVAILABLE": "unavailable",
    "DEADLINE_EXCEEDED": "deadline",  # RESOURCE_EXHAUSTED makes it pause: test_advice.py
    "ABORTED": "rejected",
    "UNAUTHENTICATED": "unauthorized",
    "PERMISSION_DENIED": "unauthorized",
    "INTERNAL": "rejected",
    "UNKNOWN": "rejected",
}


@pytest.mark.parametrize("code", FALLBACKS)
def test_rest_then_hold_then_recover(code: str) -> None:
    transport = StubTransport(None, *[fault(code, "why")] * 3)
    with client_of(transport, execute=3, budget=4) as client:
        first = client.step(OBS, WORDS)
        chunks = [client.step(OBS, WORDS) for _ in range(4)]
    assert [chunk.source for chunk in chunks] == ["rest", "rest", "hold", "cloud"]
    assert [chunk.planned for chunk in chunks] == [5, 2, 0, 8]
    np.testing.assert_array_equal(chunks[0].actions[:5], first.actions[3:])
    np.testing.assert_array_equal(chunks[1].actions[:2], first.actions[6:])
    held = np.array([0, 0, 0, first.actions[-1, 3]])
    np.testing.assert_array_equal(chunks[1].actions[2:], np.tile(held, (6, 1)))
    np.testing.assert_array_equal(chunks[2].actions, np.tile(held, (8, 1)))
    for chunk in chunks[:3]:
        assert chunk.actions.shape == (8, 4)
        assert chunk.report.fallback_reason == FALLBACKS[code]
        assert chunk.report.detail == "why"
        assert chunk.report.tokens == 4, "it was sent, though nobody answered"
        assert chunk.report.tokens_used == 0
    assert chunks[3].report.fallback_reason is None
    assert [chunk.report.step for chunk in chunks] == [1, 2, 3, 4]


def test_act_gives_one_action_a_period_and_asks_when_the_chunk_is_used_up() -> None:
    transport = StubTransport(
        None, fault("UNAVAILABLE"), fault("UNAVAILABLE"), fault("UNAVAILABLE")
    )
    with client_of(transport, execute=6, budget=4) as client:
        actions = [client.act(OBS, WORDS) for _ in range(16)]
    from_step = [int(action[0]) for action in actions]
    # Six of the first chunk, its rest of two, two periods of holding, then the next answer.
    assert from_step == [1] * 8 + [0, 0] + [5] * 6
    assert [int(action[1]) for action in actions[:8]] == list(range(8))
    assert actions[0].shape == (4,)
    assert len(transport.requests) == 5


def test_reset_begins_a_new_session_at_step_0_with_nothing_to_execute() -> None:
    transport = StubTransport(None, fault("UNAVAILABLE"), None)
    with client_of(transport, execute=2, budget=4) as client:
        before = client.step(OBS, WORDS).report
        client.reset()
        after = client.step(OBS, WORDS)
    assert after.report.session != before.session
    assert after.report.step == 0
    assert after.source == "hold", "the rest of the last episode's chunk is not executed"
    np.testing.assert_array_equal(after.actions, np.zeros((8, 4)))


def test_a_robot_that_restarts_is_not_taken_for_its_former_self() -> None:
    sessions = set()
    for _ in range(3):
        with client_of(StubTransport(), budget=4, session_id="arm") as client:
            sessions.add(client.step(OBS, WORDS).report.session)
    assert len(sessions) == 3


@pytest.mark.parametrize(
    ("code", "message", "error"),
    [
        ("INVALID_ARGUMENT", "instruction 'x': the model never saw 'x'", InstructionError),
        ("INVALID_ARGUMENT", "expected 3 proprioception values, got 2", ObservationError),
        ("INVALID_ARGUMENT", "payload: expected token_dim 12", CodecError),
        ("INVALID_ARGUMENT", "something newer", HandshakeError),
        ("FAILED_PRECONDITION", "server runs other with fingerprint 'x'", HandshakeError),
        ("UNIMPLEMENTED", "no such method", HandshakeError),
        ("RESOURCE_EXHAUSTED", "Received message larger than max (9 vs. 4)", HandshakeError),
        ("RESOURCE_EXHAUSTED", "expected a request of at most 9 bytes, got 10", HandshakeError),
    ],
)
def test_what_no_later_step_can_mend_raises_in_the_servers_words(
    code: str, message: str, error: type[Exception]
) -> None:
    with (
        client_of(StubTransport(fault(code, message)), budget=4) as client,
        pytest.raises(error) as caught,
    ):
        client.step(OBS, WORDS)
    assert message in str(caught.value)


def tampered(**changes: Any) -> Any:
    def respond(request: InferRequest) -> InferResponse:
        response = answer(request)
        for name, value in changes.items():
            if name == "actions":
                response.actions[:] = value
            else:
                setattr(response, name, value)
        return response

    return respond


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"actions": [0.0] * 31 + [math.nan]}, "not finite"),
        ({"actions": [math.inf] * 32}, "not finite"),
        ({"step": 7}, "expected the answer to step 0"),
        ({"session_id": "another"}, "expected the answer to step 0"),
    ],
)
def test_an_answer_that_must_not_be_executed_is_not(changes: dict[str, Any], words: str) -> None:
    with client_of(StubTransport(tampered(**changes)), budget=4) as client:
        chunk = client.step(OBS, WORDS)
        assert (chunk.source, chunk.report.fallback_reason) == ("hold", "rejected")
        assert words in chunk.report.detail
        assert client.step(OBS, WORDS).source == "cloud"


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"model_fingerprint": "other"}, "fingerprint other"),
        ({"action_horizon": 4}, "own description"),
        ({"action_dim": 7}, "own description"),
        ({"actions": [0.0] * 31}, "31 values"),
    ],
)
def test_an_answer_of_another_model_raises(changes: dict[str, Any], words: str) -> None:
    with (
        client_of(StubTransport(tampered(**changes)), budget=4) as client,
        pytest.raises(HandshakeError, match=words),
    ):
        client.step(OBS, WORDS)


def test_the_call_gets_what_the_edge_half_left_of_the_deadline() -> None:
    transport = StubTransport()
    with client_of(transport, budget=4, deadline_s=20.0) as client:
        report = client.step(OBS, WORDS).report
    spent_s = report.timings_s["total"]
    assert 20.0 - WIND_UP_S - spent_s <= transport.timeouts_s[0] < 20.0 - WIND_UP_S


def test_the_default_deadline_is_the_time_that_a_chunk_lasts() -> None:
    assert client_of(StubTransport(), deadline_s=None).deadline_s == pytest.approx(0.4)
    assert client_of(StubTransport(), execute=2, deadline_s=None).deadline_s == pytest.approx(0.1)


def test_an_edge_half_that_takes_all_the_time_sends_nothing() -> None:
    transport = StubTransport()
    with client_of(transport, budget=4, deadline_s=1e-9) as client:
        report = client.step(OBS, WORDS).report
    assert report.fallback_reason == "deadline"
    assert "edge half alone" in report.detail
    assert transport.requests == []


class HalfEdge(StubEdge):
    """An edge half of torch in half precision, as on an accelerator."""

    def encode(self, images: Any) -> Any:
        return torch.from_numpy(super().encode(images)).bfloat16()

    def project(self, tokens: Any) -> Any:
        return torch.from_numpy(super().project(tokens.float().numpy())).bfloat16()

    def text_queries(self, instruction: str) -> Any:
        return torch.from_numpy(super().text_queries(instruction)).bfloat16()


@pytest.mark.parametrize("selector", ["hard_voting", "soft_voting", "random", "full"])
def test_an_edge_half_of_torch_in_half_precision(selector: str) -> None:
    transport = StubTransport()
    options: dict[str, Any] = {"selector": selector, "quantization": "float32", "budget": 9}
    with client_of(transport, edge=HalfEdge(), **options) as client:
        report = client.step(OBS, WORDS).report
    tokens, positions = codec.decode(transport.requests[0].payload)
    np.testing.assert_array_equal(positions, report.positions)
    expected = HalfEdge().encode(OBS["images"]).float().numpy()[positions]
    np.testing.assert_array_equal(tokens, expected)


def test_queries_are_computed_when_the_instruction_changes() -> None:
    edge = StubEdge()
    with client_of(StubTransport(), edge=edge, budget=4) as client:
        for words in (WORDS, WORDS, "pull it", WORDS):
            client.step(OBS, words)
    assert edge.calls.count("text_queries") == 3


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"quantization": "int2"}, "int8"),
        ({"selector": "best"}, "hard_voting"),
        ({"budget": 0}, "budget"),
        ({"budget": True}, "budget"),
        ({"budget": "generous"}, "budget"),
        ({"min_tokens": 0}, "min_tokens"),
        ({"min_tokens": 33}, "min_tokens"),
        ({"execute": 9}, "execute"),
        ({"deadline_s": 0.0}, "deadline_s"),
        ({"deadline_s": math.nan}, "deadline_s"),
        ({"session_id": "with space"}, "session_id"),
        ({"session_id": "x" * 101}, "session_id"),
    ],
)
def test_options_out_of_range_are_refused(options: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        client_of(StubTransport(), **options)


def test_a_closed_client_says_so() -> None:
    transport = StubTransport()
    client = client_of(transport, budget=4)
    client.close()
    client.close()
    assert transport.closed
    for use in (lambda: client.step(OBS, WORDS), lambda: client.act(OBS, WORDS), client.reset):
        with pytest.raises(ClientClosedError, match="closed"):
            use()


def test_a_transport_of_ones_own_that_finds_no_server_is_named() -> None:
    transport = StubTransport(model=fault("UNAVAILABLE", "cable out"))
    with pytest.raises(HandshakeError, match=r"StubTransport within 5 s.*cable out"):
        client_of(transport)
    assert transport.closed


def test_the_client_tells_its_model() -> None:
    assert client_of(StubTransport()).info == INFO
