"""The transport for a target: one server, or several that answer alike."""

from __future__ import annotations

from comvla_client.access import TlsOptions, Token
from comvla_client.fleet import FleetTransport
from comvla_client.fleet_aio import FleetAioTransport
from comvla_client.targets import is_fleet
from comvla_client.transport import GrpcTransport
from comvla_client.transport_aio import GrpcAioTransport


def make_transport(
    target: str,
    tls: TlsOptions | None = None,
    token: Token | None = None,
    *,
    insecure: bool = False,
    warm_up: bool = False,
    model: str = "",
) -> GrpcTransport | FleetTransport:
    """Calls over gRPC; arguments as for :class:`comvla_client.ComVLAClient`.

    Raises:
        HandshakeError: the target is no address.
        AccessError: certificates or a token that cannot be used.
        ValueError: ``warm_up`` with several servers.
    """
    if not is_fleet(target):
        return GrpcTransport(target, tls, token, insecure=insecure, warm_up=warm_up, model=model)
    if warm_up:
        raise ValueError(
            "warm_up keeps one connection warm, and the target names several servers that take turns: "
            "give one target, or leave warm_up out"
        )
    return FleetTransport(target, tls, token, insecure=insecure, model=model)


def make_aio_transport(
    target: str,
    tls: TlsOptions | None = None,
    token: Token | None = None,
    *,
    insecure: bool = False,
    model: str = "",
) -> GrpcAioTransport | FleetAioTransport:
    """The same for an event loop."""
    make = FleetAioTransport if is_fleet(target) else GrpcAioTransport
    return make(target, tls, token, insecure=insecure, model=model)
