"""Every status of the contract against a real server with a real model: code, and a message that
names what was expected, what came, and the remedy."""

from __future__ import annotations

import itertools
import math
import threading
from collections.abc import Iterator
from typing import Any

import grpc
import numpy as np
import pytest

from comvla import codec, handshake
from comvla.model_info import PROTOCOL_VERSION, ModelInfo
from comvla.v1 import policy_pb2, policy_pb2_grpc
from comvla_server.background import BackgroundServer
from comvla_server.engine import Engine
from comvla_server.settings import ServerSettings
from comvla_vla import random_policy

PATIENCE_S = 60.0
INSTRUCTION = "pull the green drawer open"
# Without admission, so that deadlines are told from waiting, and not predicted.
SETTINGS = ServerSettings(max_request_bytes=1024 * 1024, admission=False)
_NUMBERS = itertools.count()


class GatedEngine(Engine):
    """The real engine behind a door that a test may shut."""

    def __init__(self) -> None:
        super().__init__(random_policy(seed=0)[1])
        self.door = threading.Event()
        self.door.set()
        self.inside = threading.Semaphore(0)
        self.passes = 0

    def predict(self, requests: Any) -> Any:
        self.passes += 1
        self.inside.release()
        assert self.door.wait(PATIENCE_S)
        return super().predict(requests)

    def shut(self) -> None:
        """From now on, forward passes wait at the door."""
        while self.inside.acquire(blocking=False):
            pass
        self.door.clear()

    def wait_until_inside(self) -> None:
        """Returns when a forward pass waits at the door."""
        assert self.inside.acquire(timeout=PATIENCE_S)


@pytest.fixture(scope="module")
def engine() -> GatedEngine:
    return GatedEngine()


@pytest.fixture(scope="module")
def server(engine: GatedEngine) -> Iterator[BackgroundServer]:
    with BackgroundServer(engine, SETTINGS) as running:
        yield running
        engine.door.set()


@pytest.fixture
def stub(server: BackgroundServer) -> Iterator[policy_pb2_grpc.PolicyServiceStub]:
    with grpc.insecure_channel(server.target) as channel:
        yield policy_pb2_grpc.PolicyServiceStub(channel)


@pytest.fixture(scope="module")
def info(engine: GatedEngine) -> ModelInfo:
    return engine.info


def payload(info: ModelInfo, k: int = 8, **changes: Any) -> bytes:
    """A payload of K tokens."""
    rng = np.random.default_rng(k)
    width = changes.pop("token_dim", info.token_dim)
    positions = changes.pop("positions", range(k))
    tokens = rng.normal(size=(k, width)).astype(np.float32)
    return codec.encode(tokens, np.asarray(positions), changes.pop("quantization", "int8"))


def request(info: ModelInfo, **changes: Any) -> policy_pb2.InferRequest:
    """A valid request with some fields changed."""
    fields = {
        "session_id": f"robot-{next(_NUMBERS)}",
        "step": 0,
        "instruction": INSTRUCTION,
        "proprio": [0.1] * info.proprio_dim,
        "payload": payload(info),
        "model_fingerprint": info.fingerprint,
        "protocol_version": PROTOCOL_VERSION,
    }
    return policy_pb2.InferRequest(**{**fields, **changes})


def patched(content: bytes, at: int, patch: bytes) -> bytes:
    """Bytes as another program might have written them: the codec itself refuses to."""
    at %= len(content)
    return content[:at] + patch + content[at + len(patch) :]


def refusal(call: Any) -> tuple[grpc.StatusCode, str]:
    error = call.exception(timeout=PATIENCE_S)
    assert error is not None, "expected a refusal, the call was answered"
    return error.code(), error.details()


def record_bytes(info: ModelInfo, quantization: str) -> int:
    """Bytes of one token on the wire."""
    one, two = (codec.encoded_bytes(k, info.token_dim, quantization) for k in (1, 2))
    return two - one


INVALID = grpc.StatusCode.INVALID_ARGUMENT
MISMATCH = grpc.StatusCode.FAILED_PRECONDITION
TOO_MUCH = grpc.StatusCode.RESOURCE_EXHAUSTED


def wrong_requests(info: ModelInfo) -> dict[str, tuple[dict[str, Any], Any, tuple[str, ...]]]:
    """Change, status, and words that the message must hold: expected, came, remedy."""
    n, d = info.num_tokens, info.token_dim
    int8 = record_bytes(info, "int8")
    float32 = payload(info, quantization="float32")
    same_checkpoint = "edge half of the same checkpoint"
    return {
        "token width": (
            {"payload": payload(info, token_dim=d + 1)},
            INVALID,
            (f"token_dim {d}", f"token_dim {d + 1}", same_checkpoint),
        ),
        "position out of range": (
            {"payload": payload(info, positions=[*range(7), n])},
            INVALID,
            (f"0 to {n - 1}", f"got {n}", "same model"),
        ),
        "position repeated": (
            {"payload": patched(payload(info), -int8, (0).to_bytes(2, "little"))},
            INVALID,
            ("each position once", "got 0 twice", "without repetition"),
        ),
        "NaN value": (
            {"payload": patched(float32, -4, np.float32(math.nan).tobytes())},
            INVALID,
            ("expected finite token values", "NaN", "check the vision towers"),
        ),
        "infinite scale": (
            {"payload": patched(payload(info), -int8 + 2, np.float32(math.inf).tobytes())},
            INVALID,
            ("expected positive, finite scales", "inf", "damaged"),
        ),
        "no token": (
            {"payload": payload(info, k=0)},
            INVALID,
            (f"expected 1 to {n} tokens", "got none", "rest of the last chunk"),
        ),
        "more tokens than the model has": (
            {"payload": payload(info, k=n + 1)},
            INVALID,
            (f"at most {n}", str(n + 1), "lower the token budget"),
        ),
        "unknown quantization": (
            {"payload": patched(payload(info), 5, b"\x63")},
            INVALID,
            ("quantization", "99"),
        ),
        "payload of something else": (
            {"payload": b"\x80\x04 pickled, surely"},
            INVALID,
            ("payload", "comvla.codec.encode"),
        ),
        "empty payload": ({"payload": b""}, INVALID, ("payload", "0 bytes", "empty")),
        "non-finite proprioception": (
            {"proprio": [math.nan] * info.proprio_dim},
            INVALID,
            ("finite proprioception", "nan", "sensor"),
        ),
        "missing proprioception": (
            {"proprio": []},
            INVALID,
            (f"expected {info.proprio_dim}", "got 0", "raw vector"),
        ),
        "empty instruction": (
            {"instruction": ""},
            INVALID,
            ("instruction", "empty", "say what the robot should do"),
        ),
        "unknown words": (
            {"instruction": "fry the egg"},
            INVALID,
            ("instruction 'fry the egg'", "never saw", "it knows"),
        ),
        "endless instruction": (
            {"instruction": "push " * 1000},
            INVALID,
            ("at most 2000 characters", "5000", "fewer words"),
        ),
        "long instruction": (
            {"instruction": "push " * (info.max_prompt_tokens + 1)},
            INVALID,
            ("instruction", str(info.max_prompt_tokens), "fewer words"),
        ),
        "session without a name": ({"session_id": ""}, INVALID, ("session_id", "''", "UUID")),
        "fingerprint": (
            {"model_fingerprint": "0123456789abcdef"},
            MISMATCH,
            (info.fingerprint, "0123456789abcdef", same_checkpoint),
        ),
        "no fingerprint": (
            {"model_fingerprint": ""},
            MISMATCH,
            (info.fingerprint, "''", same_checkpoint),
        ),
        "protocol": (
            {"protocol_version": PROTOCOL_VERSION + 1},
            MISMATCH,
            (f"version {PROTOCOL_VERSION}", str(PROTOCOL_VERSION + 1), "same comvla release"),
        ),
        "oversize message": (
            {"payload": bytes(SETTINGS.max_request_bytes)},
            TOO_MUCH,
            (f"at most {SETTINGS.max_request_bytes} bytes", "got 1048", "send fewer tokens"),
        ),
    }


@pytest.mark.parametrize("fault", list(wrong_requests(random_policy(seed=0)[1].info)))
def test_a_wrong_request_is_refused_before_it_costs_compute(
    stub: policy_pb2_grpc.PolicyServiceStub, engine: GatedEngine, fault: str
) -> None:
    changes, status, words = wrong_requests(engine.info)[fault]
    before = engine.passes
    code, details = refusal(stub.Infer.future(request(engine.info, **changes), timeout=PATIENCE_S))
    assert code is status
    for word in words:
        assert word in details
    assert engine.passes == before


def test_a_message_beyond_the_hard_cap_is_refused_by_grpc_itself(
    stub: policy_pb2_grpc.PolicyServiceStub, info: ModelInfo
) -> None:
    huge = request(info, payload=bytes(3 * SETTINGS.max_request_bytes))
    code, details = refusal(stub.Infer.future(huge, timeout=PATIENCE_S))
    assert code is TOO_MUCH
    assert "larger than max" in details


def test_an_expired_deadline_costs_no_compute(
    server: BackgroundServer, stub: policy_pb2_grpc.PolicyServiceStub, engine: GatedEngine
) -> None:
    engine.shut()
    running = stub.Infer.future(request(engine.info, session_id="a"), timeout=PATIENCE_S)
    engine.wait_until_inside()
    passes = engine.passes
    code, _ = refusal(stub.Infer.future(request(engine.info, session_id="b"), timeout=0.05))
    assert code is grpc.StatusCode.DEADLINE_EXCEEDED
    engine.door.set()
    assert running.result().batch_size == 1
    stub.Infer(request(engine.info, session_id="c"), timeout=PATIENCE_S)
    assert engine.passes == passes + 1


def test_overload_is_resource_exhausted(engine: GatedEngine) -> None:
    settings = ServerSettings(max_queue=1, max_batch=1)
    with (
        BackgroundServer(engine, settings) as server,
        grpc.insecure_channel(server.target) as channel,
    ):
        stub = policy_pb2_grpc.PolicyServiceStub(channel)
        engine.shut()
        calls = [
            stub.Infer.future(request(engine.info, session_id=f"s{i}"), timeout=PATIENCE_S)
            for i in range(3)
        ]
        # One runs, one waits, one is refused, in whatever order the three arrived.
        engine.wait_until_inside()
        done = threading.Semaphore(0)
        for call in calls:
            call.add_done_callback(lambda _: done.release())
        assert done.acquire(timeout=PATIENCE_S)
        (refused,) = [call for call in calls if call.done()]
        code, details = refusal(refused)
        assert code is TOO_MUCH
        for word in ("1 of 1 sessions wait", "ask less often", "add a replica"):
            assert word in details
        engine.door.set()
        assert sum(call.exception(PATIENCE_S) is None for call in calls) == 2


def test_a_draining_server_is_unavailable(engine: GatedEngine) -> None:
    with (
        BackgroundServer(engine, SETTINGS) as server,
        grpc.insecure_channel(server.target) as channel,
    ):
        stub = policy_pb2_grpc.PolicyServiceStub(channel)
        engine.shut()
        running = stub.Infer.future(request(engine.info), timeout=PATIENCE_S)
        engine.wait_until_inside()
        stopper = threading.Thread(target=server.stop, kwargs={"grace_s": PATIENCE_S})
        stopper.start()
        code = grpc.StatusCode.DEADLINE_EXCEEDED
        while code is grpc.StatusCode.DEADLINE_EXCEEDED:  # the stop is on its way
            code, details = refusal(stub.Infer.future(request(engine.info), timeout=0.2))
        assert code is grpc.StatusCode.UNAVAILABLE
        for word in ("draining", "no new calls", "another replica"):
            assert word in details
        engine.door.set()
        assert len(running.result().actions) > 0
        stopper.join(PATIENCE_S)


def test_the_handshake_names_the_model_and_the_cap(
    stub: policy_pb2_grpc.PolicyServiceStub, info: ModelInfo
) -> None:
    response = stub.GetModel(
        policy_pb2.GetModelRequest(protocol_version=PROTOCOL_VERSION), timeout=PATIENCE_S
    )
    assert handshake.from_response(response) == info
    assert handshake.mismatch(info, handshake.from_response(response)) is None
    assert response.max_request_bytes == SETTINGS.max_request_bytes
    assert response.server_version


@pytest.mark.parametrize("quantization", codec.QUANTIZATIONS)
@pytest.mark.parametrize("k", [1, 16, 512])
def test_every_quantization_and_size_is_answered(
    stub: policy_pb2_grpc.PolicyServiceStub, info: ModelInfo, quantization: str, k: int
) -> None:
    content = payload(info, k=k, quantization=quantization)
    response = stub.Infer(request(info, payload=content), timeout=PATIENCE_S)
    assert response.tokens_used == k
    assert len(response.actions) == info.action_horizon * info.action_dim
    assert np.isfinite(response.actions).all()
    assert response.cloud_flops > 0


def test_a_payload_cut_on_the_link_is_answered_with_what_arrived(
    stub: policy_pb2_grpc.PolicyServiceStub, info: ModelInfo
) -> None:
    content = payload(info, k=16)
    cut = content[: len(content) - record_bytes(info, "int8") - 1]
    response = stub.Infer(request(info, payload=cut), timeout=PATIENCE_S)
    assert response.tokens_used == 14
