"""A server without sockets: codec, validation and model of the real one, called directly."""

from __future__ import annotations

import time

from comvla import codec, handshake
from comvla.v1.policy_pb2 import GetModelResponse, InferRequest, InferResponse, ServerTimings
from comvla_client.errors import TransportError
from comvla_client.streaming import PayloadStream
from comvla_server.engine import CloudHalf, Engine
from comvla_server.refusals import Refusal
from comvla_server.settings import ServerSettings
from comvla_server.statuses import STATUS
from comvla_server.validation import Validator
from comvla_server.version import server_version
from comvla_server.vision import Vision


class InProcessTransport:
    """A client transport that answers by running the cloud half here and now.

    Requests are serialised and read back, validated and decoded exactly as in the server; queue,
    batching and deadlines are left out. One closed loop waits for each answer anyway.

    Args:
        cloud: the cloud half.
        vision: the vision half, for clients that send pictures.
    """

    def __init__(self, cloud: CloudHalf, vision: Vision | None = None) -> None:
        self._engine = Engine(cloud, vision)
        self._max_request_bytes = ServerSettings().max_request_bytes
        self._validator = Validator(self._engine, self._max_request_bytes)

    def get_model(self, timeout_s: float) -> GetModelResponse:
        """Describes the model."""
        del timeout_s  # an answer without a network is there at once
        return handshake.to_response(
            self._engine.info,
            quantizations=codec.QUANTIZATIONS,
            max_request_bytes=self._max_request_bytes,
            server_version=server_version(),
            progressive=True,
            image_codings=self._engine.image_codings,
            run_options=self._engine.run_options,
        )

    def infer(self, request: InferRequest, timeout_s: float) -> InferResponse:
        """Actions for one observation.

        Raises:
            TransportError: with the status code and message that a server would send.
        """
        del timeout_s
        arrived = InferRequest.FromString(request.SerializeToString())
        started = time.perf_counter()
        try:
            self._validator.check_identity(arrived)
            policy_request = self._validator.read(arrived)
        except Refusal as refusal:
            raise TransportError(STATUS[refusal.reason].name, refusal.message) from refusal
        decoded = time.perf_counter()
        (actions,) = self._engine.predict([policy_request])
        done = time.perf_counter()
        return InferResponse(
            session_id=arrived.session_id,
            step=arrived.step,
            actions=actions.ravel().tolist(),
            action_horizon=actions.shape[0],
            action_dim=actions.shape[1],
            tokens_used=self._engine.num_tokens(policy_request),
            batch_size=1,
            cloud_flops=self._engine.flops(policy_request),
            timings=ServerTimings(
                decode_s=decoded - started, predict_s=done - decoded, total_s=done - started
            ),
            model_fingerprint=self._engine.info.fingerprint,
        )

    def infer_progressive(self, stream: PayloadStream, timeout_s: float) -> InferResponse:
        """Actions for a payload in pieces, all of which arrive here.

        Raises:
            TransportError: with the status code and message that a server would send.
        """
        stream.taken = len(stream.ends)
        return self.infer(stream.prefix(stream.taken), timeout_s)

    def close(self) -> None:
        """Nothing to close."""
