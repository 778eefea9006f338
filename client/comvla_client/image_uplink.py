"""Coded pictures instead of tokens: the cloud sees, the robot needs no model and no torch."""

from __future__ import annotations

import time

import numpy as np

from comvla import handshake
from comvla.errors import HandshakeError
from comvla.images import coding_number, picture_bytes
from comvla.v1.policy_pb2 import CodedImage, CodedImages, GetModelResponse
from comvla_client.image_encoders import ImageEncoder, Pictures
from comvla_client.observation import CheckedObservation
from comvla_client.sizing import ByteSizer
from comvla_client.uplink import Setup, Uplink


class ImageUplink:
    """All views, coded by one encoder, with vision in the cloud.

    A budget counts bytes here: ``"paper"`` those of the pictures, ``"framed"`` all that cross the wire, a number
    fixes how many the pictures may have. Without an SNR nothing limits a fixed quality. Where the encoder
    leaves the quality open, the best that fits is taken; where not even the worst fits, nothing is sent.

    Args:
        encoder: who codes the pictures.
        name: for reports; coding and quality by default.
    """

    needs_edge = False
    in_pieces = False

    def __init__(self, encoder: ImageEncoder, name: str | None = None) -> None:
        self._encoder = encoder
        fixed = f"-{encoder.qualities[0]}" if len(encoder.qualities) == 1 else ""
        self.name = name or encoder.coding + fixed

    @property
    def adjustable(self) -> bool:
        """Whether the link decides the quality."""
        return len(self._encoder.qualities) > 1

    def start(self, setup: Setup) -> None:
        """Learns who the robot is.

        Raises:
            ValueError: a budget that does not exist.
        """
        self.sizer = ByteSizer(setup.link, setup.budget, adjustable=self.adjustable)
        self._framed = setup.budget == "framed"

    def check_server(self, response: GetModelResponse) -> None:
        """Whether the server sees, and reads this coding.

        Raises:
            HandshakeError: it does not; with the remedy.
        """
        offered = handshake.offered_image_codings(response)
        difference = handshake.image_coding_mismatch(self._encoder.coding, offered)
        if difference is not None:
            raise HandshakeError(difference)

    def hear(self, instruction: str) -> None:
        """The words go up the link as they are; the server reads them."""

    def compress(self, obs: CheckedObservation, count: int, rng: np.random.Generator) -> Uplink:
        """Codes all views in at most ``count`` bytes, at the best quality that allows."""
        del rng
        started = time.perf_counter()
        qualities = list(self._encoder.qualities)
        smallest, flops = 0, 0.0
        # Bisection, best first: a roomy link costs one coding, a tight one four or five.
        low, high, middle = 0, len(qualities), len(qualities) - 1
        best: tuple[int, CodedImages] | None = None
        while low < high:
            coded, cost_flops = self._coded(obs.images, qualities[middle])
            flops += cost_flops
            if self._cost_bytes(coded) <= count:
                best, low = (qualities[middle], coded), middle + 1
            else:
                smallest, high = self._cost_bytes(coded), middle
            middle = (low + high) // 2
        encode_s = time.perf_counter() - started
        if best is None:
            self._encoder.reset()  # what was coded just now is never sent
            return Uplink(
                timings_s={"encode": encode_s},
                flops=flops,
                refusal=f"the pictures take {smallest} bytes as {self._encoder.coding}-{qualities[0]}, the "
                f"link carries {count}",
            )
        return Uplink(
            images=best[1],
            payload_bytes=picture_bytes(best[1]),
            timings_s={"encode": encode_s},
            flops=flops,
            quality=best[0] if self.adjustable else None,
        )

    def settle(self, step: int, answered: bool) -> None:
        """For encoders over time."""
        self._encoder.settle(step, answered)

    def reset(self) -> None:
        """Begins a new episode, for encoders over time."""
        self._encoder.reset()

    def _coded(self, images: Pictures, quality: int) -> tuple[CodedImages, float]:
        coded = self._encoder.encode(images, quality)
        message = CodedImages(
            coding=coding_number(self._encoder.coding),
            views=[
                CodedImage(data=data, height=image.shape[0], width=image.shape[1])
                for data, image in zip(coded.data, images, strict=True)
            ],
            follows_step=coded.follows_step,
        )
        return message, coded.flops

    def _cost_bytes(self, coded: CodedImages) -> int:
        return coded.ByteSize() if self._framed else picture_bytes(coded)
