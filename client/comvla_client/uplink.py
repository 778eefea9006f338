"""What goes up the link for one observation: the interface of all its forms.

A form is told once who the robot is (:class:`Setup`), and then asked for each step what shall be
sent (:meth:`UplinkForm.compress`), in as many tokens or bytes as its sizer made of what the link
carries. Tokens by a selector are the product (:class:`comvla_client.token_uplink.TokenUplink`);
coded pictures, which the cloud has to look at, are what everybody else sends
(:class:`comvla_client.image_uplink.ImageUplink`). :mod:`comvla_client.registry` knows both by name.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import numpy.typing as npt

from comvla.model_info import ModelInfo
from comvla.v1.policy_pb2 import CodedImages, GetModelResponse, InferRequest
from comvla_client.budget import LinkProfile
from comvla_client.edge import EdgeModel
from comvla_client.observation import CheckedObservation
from comvla_client.sizing import Budget, Sizer


def _no_positions() -> npt.NDArray[np.int32]:
    return np.zeros(0, dtype=np.int32)


@dataclass(frozen=True)
class Setup:
    """What a form is told about its robot, once.

    Attributes:
        info: the model that both sides run.
        edge: the robot's half; None on a robot that has none.
        link: the radio link.
        quantization: how token values are coded.
        budget: see :data:`comvla_client.sizing.Budget`.
        min_tokens: fewest tokens worth sending.
    """

    info: ModelInfo
    edge: EdgeModel | None
    link: LinkProfile
    quantization: str
    budget: Budget
    min_tokens: int


@dataclass(frozen=True)
class Uplink:
    """What one step sends, and what that cost. Exactly one of ``payload`` and ``images``, or neither.

    Attributes:
        payload: coded tokens, most important first.
        images: coded pictures.
        positions: (K,) int32 of the tokens; empty for pictures.
        payload_bytes: by the paper's accounting: K·D·B/8 for tokens, their files for pictures.
        timings_s: seconds by phase, of :data:`comvla_client.report.PHASES`.
        flops: operations on the robot.
        quality: of the pictures, where it was chosen.
        refusal: why nothing is sent, where it is neither.
    """

    payload: bytes = b""
    images: CodedImages | None = None
    positions: npt.NDArray[np.int32] = field(default_factory=_no_positions)
    payload_bytes: int = 0
    timings_s: dict[str, float] = field(default_factory=dict)
    flops: float = 0.0
    quality: int | None = None
    refusal: str = ""

    @property
    def encoded_bytes(self) -> int:
        """Length of what is sent with all that it needs to be read: positions and scales, or sizes."""
        return len(self.payload) if self.images is None else self.images.ByteSize()

    @property
    def sends(self) -> bool:
        """Whether there is anything to send."""
        return bool(self.payload) or self.images is not None

    def fill(self, request: InferRequest) -> None:
        """Puts it into a request that holds everything else."""
        if self.images is None:
            request.payload = self.payload
        else:
            request.images.CopyFrom(self.images)


class UplinkForm(Protocol):
    """A way of telling the cloud what the robot sees. One object serves one client.

    Attributes:
        name: for reports and tables.
        needs_edge: whether the robot needs its half of the model, and with it torch.
        in_pieces: whether a part of what it sends is of use.
        sizer: what so many bits carry, from :meth:`start` on.
    """

    @property
    def name(self) -> str: ...

    @property
    def needs_edge(self) -> bool: ...

    @property
    def in_pieces(self) -> bool: ...

    @property
    def sizer(self) -> Sizer: ...

    def start(self, setup: Setup) -> None:
        """Learns who the robot is, before anything else.

        Raises:
            ValueError: an option that this form cannot work with.
        """
        ...

    def check_server(self, response: GetModelResponse) -> None:
        """Compares what the server reads with what this form sends.

        Raises:
            HandshakeError: the server would refuse it; with the remedy.
        """
        ...

    def hear(self, instruction: str) -> None:
        """Takes note of the instruction, before the observation.

        Raises:
            InstructionError: this form works with words, and cannot read these.
        """
        ...

    def compress(self, obs: CheckedObservation, count: int, rng: np.random.Generator) -> Uplink:
        """What to send for an observation.

        Args:
            obs: a checked observation.
            count: the most that it may be, tokens or bytes; at least 1.
            rng: for forms that draw.
        """
        ...

    def settle(self, step: int, answered: bool) -> None:
        """Learns what became of the step that was compressed last.

        Args:
            step: its number in the session.
            answered: whether the server answered, so that it surely has what was sent.
        """
        ...

    def reset(self) -> None:
        """Begins a new episode."""
        ...
