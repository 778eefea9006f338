"""The edge SDK: what a robot needs to be driven by a policy in the cloud.

Imports NumPy and gRPC and nothing heavier; torch is used only where the edge model is made of it.
"""

from comvla_client.access import AccessError, TlsOptions
from comvla_client.aio import AsyncComVLAClient
from comvla_client.budget import LinkProfile, framed_token_budget, token_budget
from comvla_client.client import ComVLAClient
from comvla_client.errors import ClientClosedError, TransportError
from comvla_client.report import ActionChunk, StepReport
from comvla_client.snr import SnrReading

__all__ = [
    "AccessError",
    "ActionChunk",
    "AsyncComVLAClient",
    "ClientClosedError",
    "ComVLAClient",
    "LinkProfile",
    "SnrReading",
    "StepReport",
    "TlsOptions",
    "TransportError",
    "framed_token_budget",
    "token_budget",
]
