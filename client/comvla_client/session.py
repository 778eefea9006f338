"""What a robot's steps are called on the wire: session, episode and step."""

from __future__ import annotations

import math
import re
import secrets

import numpy as np

from comvla.model_info import PROTOCOL_VERSION, ModelInfo
from comvla.v1.policy_pb2 import InferRequest
from comvla_client.snr import SnrReading

_SESSION_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._:@/+=-]{0,99}")


class Session:
    """Counts steps and episodes, so that no two steps ever have the same name.

    Args:
        session_id: the robot's name; None for one like any other.
        seed: of what is drawn at random.
        model: name of the model to ask for, where the server has several; empty for its default.

    Raises:
        ValueError: the name cannot be used on the wire.
    """

    def __init__(self, session_id: str | None, seed: int, model: str) -> None:
        self._robot = _robot_name(session_id)
        self._seed = seed
        self._model = model
        self._episode = 0
        self._step = 0

    @property
    def name(self) -> str:
        """Identity of the current episode on the wire."""
        return f"{self._robot}.{self._episode}"

    def reset(self) -> None:
        """Begins a new episode, with step 0."""
        self._episode += 1
        self._step = 0

    def request(
        self, info: ModelInfo, instruction: str, proprio: list[float], reading: SnrReading | None
    ) -> InferRequest:
        """The request of the current step, without what it sends of its pictures.

        Args:
            info: the model that both sides run.
            instruction: what the robot is told to do.
            proprio: its own state, (P,) values.
            reading: the link's state as far as it is known.
        """
        request = InferRequest(
            session_id=self.name,
            step=self._step,
            instruction=instruction,
            proprio=proprio,
            model_fingerprint=info.fingerprint,
            protocol_version=PROTOCOL_VERSION,
            model=self._model,
        )
        if reading is not None and math.isfinite(reading.snr_db):
            request.snr_db, request.snr_age_s = reading.snr_db, reading.age_s
        return request

    def next_step(self) -> np.random.Generator:
        """Ends the current step; what it draws at random, the same for the same seed, episode and step."""
        rng = np.random.default_rng([self._seed, self._episode, self._step])
        self._step += 1
        return rng


def _robot_name(session_id: str | None) -> str:
    # The random part keeps a restarted robot from being answered out of the record that the
    # server holds of its former life.
    name, nonce = session_id or "robot", secrets.token_hex(4)
    if not _SESSION_NAME.fullmatch(name):
        raise ValueError(
            "expected a session_id of 1 to 100 letters, digits or ._:@/+=- that begins with a "
            f"letter or digit, got {session_id!r}"
        )
    return f"{name}.{nonce}"
