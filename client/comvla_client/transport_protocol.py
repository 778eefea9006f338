"""What carries a request to the server, as far as clients need to know."""

from __future__ import annotations

from typing import Protocol

from comvla.v1.policy_pb2 import GetModelResponse, InferRequest, InferResponse
from comvla_client.streaming import PayloadStream


class Transport(Protocol):
    """Carries calls to a policy server. Wrap one to emulate a link, record, or inject faults."""

    def get_model(self, timeout_s: float) -> GetModelResponse:
        """The server's description of its model.

        Raises:
            TransportError: no usable answer within ``timeout_s`` seconds.
        """
        ...

    def infer(self, request: InferRequest, timeout_s: float) -> InferResponse:
        """Actions for one observation.

        Raises:
            TransportError: no usable answer within ``timeout_s`` seconds.
        """
        ...

    def close(self) -> None:
        """Ends calls under way and frees the connection. May be called from another thread."""
        ...


class ProgressiveTransport(Transport, Protocol):
    """A transport that also takes payloads in pieces, for policies that send so."""

    def infer_progressive(self, stream: PayloadStream, timeout_s: float) -> InferResponse:
        """Actions for as much of one observation as arrives within the stream's window.

        Raises:
            TransportError: no usable answer within ``timeout_s`` seconds.
        """
        ...
