"""Which parts of a client go together: what goes up the link, how it is sent, the edge model, the transport."""

from __future__ import annotations

from comvla_client.edge import EdgeModel
from comvla_client.sending import Floor, SendingPolicy
from comvla_client.uplink import UplinkForm


def check_parts(form: UplinkForm, sending: SendingPolicy, edge: EdgeModel | None) -> None:
    """Whether a policy of sending and a robot's half can do what a form of the uplink needs.

    Args:
        form: what goes up the link.
        sending: how much of it when.
        edge: the robot's half of the model; None on a robot that has none.

    Raises:
        ValueError: the first two that do not go together, with the remedy.
    """
    if sending.progressive and not form.in_pieces:
        raise ValueError(
            f"sending={sending.name!r} sends tokens piece by piece, {form.name} sends "
            "pictures, which arrive whole or not at all: choose sending='paper' or 'margin'"
        )
    if isinstance(sending, Floor) and not form.in_pieces:
        raise ValueError(
            f"sending={sending.name!r} has a floor in tokens, {form.name} sends pictures: "
            "choose sending='paper' or 'margin'"
        )
    if form.needs_edge and edge is None:
        raise ValueError(
            f"{form.name} sends tokens, which takes the robot's half of the model: pass "
            "edge=load_edge(...), or let the cloud see with uplink='jpeg-75'"
        )


def check_transport(sending: SendingPolicy, transport: object) -> None:
    """Whether a transport can carry what a policy of sending will ask of it.

    Args:
        sending: the policy.
        transport: synchronous or asynchronous.

    Raises:
        ValueError: the policy sends pieces, and it takes none.
    """
    if sending.progressive and not hasattr(transport, "infer_progressive"):
        raise ValueError(
            f"sending={sending.name!r} needs a transport with infer_progressive(stream, "
            f"timeout_s), {type(transport).__name__} has none: add it, or choose another policy"
        )
