"""Pictures as analogue symbols: a learned codec on the robot, its decoder in the cloud.

There is no analogue radio behind this client, so it stands in for one: the symbols get the phase and
the noise of one control period here, and the request carries what a receiver would hand on. Bytes are
counted as the paper does, a float32 latent; what the air carries are channel uses.
"""

from __future__ import annotations

import cmath
import math
import time
from typing import TYPE_CHECKING

import numpy as np

from comvla import handshake
from comvla.errors import DependencyError, HandshakeError, LinkError
from comvla.images import coding_number, most_data_bytes
from comvla.v1.policy_pb2 import CodedImage, CodedImages, GetModelResponse, InferRequest
from comvla_client.budget import LinkProfile
from comvla_client.observation import CheckedObservation
from comvla_client.uplink import Setup, Uplink

if TYPE_CHECKING:
    from comvla_vla.codecs import Rate, TrainedCodec

CODINGS = {"deepjscc": "deep_jscc", "witt": "witt"}
"""Codec to the contract's name of its symbols."""


class SymbolSizer:
    """Counts channel uses in place of tokens: as many complex symbols as a period has, W·T, or none.

    Args:
        link: the radio link.
        needs_snr: whether the SNR of the period is the reported one.
    """

    min_tokens = 1
    sends_all = False

    def __init__(self, link: LinkProfile, *, needs_snr: bool) -> None:
        self.link = link
        self.needs_snr = needs_snr
        self.snr_db: float | None = None

    @property
    def num_tokens(self) -> int:
        """Channel uses of a period."""
        return int(self.link.bandwidth_hz * self.link.period_s)

    @property
    def most_tokens(self) -> int:
        """The same: a codec has one rate."""
        return self.num_tokens

    def tokens_in(
        self, bits: float, request: InferRequest, *, progressive: bool, least: int, window_s: float
    ) -> int:
        """All of the period's, whatever its capacity, unless that is nothing."""
        self.snr_db = request.snr_db if request.HasField("snr_db") else None
        return self.num_tokens if bits > 0 else 0

    def token_budgets(
        self, bits: float, request: InferRequest, *, progressive: bool, least: int, window_s: float
    ) -> None:
        """Pictures are no tokens."""


class SymbolUplink:
    """All views by one learned codec, through one period of the channel.

    Both sides know the SNR. The magnitude of the period's gain is part of it, so that the gain drawn
    here is a phase.

    Args:
        codec: ``"deepjscc"``, ``"witt"``, a folder of ``comvla-sim train codec``, or a trained codec.
        snr_db: of every period; None takes the SNR that each step reports.
        name: for reports; codec and SNR by default.

    Raises:
        DependencyError: torch is not installed.
        CheckpointError: there is no such codec.
        LinkError: an SNR that no link has.
    """

    needs_edge = False
    in_pieces = False

    def __init__(
        self, codec: str | TrainedCodec, snr_db: float | None = None, name: str | None = None
    ) -> None:
        if snr_db is not None and not math.isfinite(snr_db):
            raise LinkError(f"expected a finite SNR in dB, got {snr_db!r}")
        self._trained = _load(codec) if isinstance(codec, str) else codec
        self._snr_db = snr_db
        own = self._trained.name
        self.name = name or (own if snr_db is None else f"{own}-{snr_db:g}")
        self._flops: dict[tuple[int, int], float] = {}

    @property
    def adjustable(self) -> bool:
        """Whether the link decides how good the pictures are."""
        return self._snr_db is None

    def rate(self, height: int, width: int) -> Rate:
        """Values, bytes and channel uses of one view. CodecError for a size that the codec cannot take."""
        from comvla_vla.codecs import rate

        return rate(self._trained.codec.config, height, width)

    def start(self, setup: Setup) -> None:
        """Learns who the robot is.

        Raises:
            CodecError: the model's pictures have a size that the codec cannot take.
            ValueError: they take more symbols than a control period has, or a request may hold.
        """
        height, width = setup.info.image_size
        views, cost = setup.info.grid[0], self.rate(height, width)
        self.sizer = SymbolSizer(setup.link, needs_snr=self._snr_db is None)
        if views * cost.channel_uses > self.sizer.num_tokens:
            raise ValueError(
                f"{self.name} takes {views * cost.channel_uses} channel uses for {views} pictures, a "
                f"period of this link has {self.sizer.num_tokens}: use smaller pictures or more bandwidth"
            )
        if cost.latent_bytes >= most_data_bytes(height, width):
            raise ValueError(
                f"{self.name} takes {cost.latent_bytes} bytes for a picture of {height}×{width} pixels, "
                f"servers read {most_data_bytes(height, width)}: use smaller pictures"
            )

    def check_server(self, response: GetModelResponse) -> None:
        """Whether the server sees, and has a decoder for these symbols.

        Raises:
            HandshakeError: it has not; with the remedy.
        """
        offered = handshake.offered_image_codings(response)
        difference = handshake.image_coding_mismatch(CODINGS[self._trained.name], offered)
        if difference is not None:
            raise HandshakeError(difference)

    def hear(self, instruction: str) -> None:
        """The words go up the link as they are; the server reads them."""

    def compress(self, obs: CheckedObservation, count: int, rng: np.random.Generator) -> Uplink:
        """Codes all views and sends them through one period.

        Args:
            obs: a checked observation.
            count: channel uses that there are.
            rng: of phase and noise.
        """
        import torch

        from comvla_vla.codecs.analogue import noise_power, transmit
        from comvla_vla.codecs.image_codec import told_snr_db
        from comvla_vla.codecs.waveform import uint8_to_float, write_waveform

        snr_db = self.sizer.snr_db if self._snr_db is None else self._snr_db
        if snr_db is None:
            raise LinkError(
                f"{self.name} needs the SNR of the period: pass step(..., snr=dB), give the client an snr "
                f"source, or fix it with '{self.name}-10'"
            )
        started = time.perf_counter()
        height, width = obs.images[0].shape[:2]
        cost = self.rate(height, width)
        uses = len(obs.images) * cost.channel_uses
        if uses > count:
            return Uplink(refusal=f"the pictures take {uses} channel uses, there are {count}")
        gain = cmath.exp(2j * math.pi * rng.uniform())
        generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
        with torch.inference_mode():
            images = uint8_to_float(np.stack(obs.images))
            snr = torch.full((len(images),), float(snr_db))
            noise = noise_power(snr)
            symbols = self._trained.codec.encode(images, told_snr_db(snr))
            gains = torch.full((len(images),), gain, dtype=torch.complex64)
            received = transmit(symbols, gains, noise, generator)
        views = [
            CodedImage(
                data=write_waveform(row, gain, float(noise[0]), self._trained),
                height=height,
                width=width,
            )
            for row in received.numpy()
        ]
        coding = coding_number(CODINGS[self._trained.name])
        return Uplink(
            images=CodedImages(coding=coding, views=views),
            payload_bytes=len(views) * cost.latent_bytes,
            timings_s={"encode": time.perf_counter() - started},
            flops=len(views) * self._encoder_flops(height, width),
        )

    def settle(self, step: int, answered: bool) -> None:
        """Every picture stands alone."""

    def reset(self) -> None:
        """Every picture stands alone."""

    def _encoder_flops(self, height: int, width: int) -> float:
        from comvla_vla.codecs.image_codec import codec_flops

        if (height, width) not in self._flops:
            encoder, _ = codec_flops(self._trained.codec.config, height, width)
            self._flops[height, width] = float(encoder)
        return self._flops[height, width]


def _load(codec: str) -> TrainedCodec:
    try:
        from comvla_vla.codecs import load_codec
    except ImportError as error:
        raise DependencyError(
            f"{codec} needs torch, which is not installed: pip install 'comvla[edge]'"
        ) from error
    return load_codec(codec)
