"""The handshake: what robot and server must agree on before the robot moves."""

from __future__ import annotations

from collections.abc import Iterable

from comvla import handshake
from comvla.errors import HandshakeError, ModelChangedError
from comvla.model_info import ModelInfo


def check_model(cloud: ModelInfo, edge: ModelInfo, also: Iterable[str] = ()) -> None:
    """Compares the server's model with the robot's half.

    What a robot sends for an observation is for its uplink form to compare (``check_server``).

    Args:
        cloud: the server's description of its model, read with :func:`comvla.handshake.from_response`.
        edge: the robot's half.
        also: fingerprints of models whose robots the server answers too.

    Raises:
        HandshakeError: the first difference in words, with its remedy.
    """
    difference = handshake.mismatch(edge, cloud, also)
    if difference is not None:
        raise HandshakeError(difference)


def check_successor(cloud: ModelInfo, before: ModelInfo) -> None:
    """Whether a robot that can work with any model moves as before with the server's new one.

    Args:
        cloud: the server's description of its new model.
        before: that of the model before.

    Raises:
        ModelChangedError: the first difference in words, with its remedy.
    """
    for name in ("action_dim", "delta_actions", "control_period_s"):
        if getattr(before, name) != getattr(cloud, name):
            raise ModelChangedError(
                f"the server has another model now, {cloud.name}, whose {name} is "
                f"{getattr(cloud, name)}, expected {getattr(before, name)}: make a new client"
            )
