"""How the cloud half is run: switches that change no weight and no shape on the link."""

from __future__ import annotations

from dataclasses import dataclass

from comvla.handshake import COMPACT_POSITIONS


@dataclass(frozen=True)
class FastV:
    """Drops visual tokens inside the backbone, by what the stop token looked at.

    It saves operations, not bytes: the layers before ``layer`` want every token, so all of them are sent.

    Attributes:
        layer: K; the attention of layer K - 1 ranks, layer K is the first to run with fewer tokens.
        drop_ratio: R, the share of visual tokens dropped; round(n * (1 - R)) of n stay.
    """

    layer: int = 3
    drop_ratio: float = 0.75

    def __post_init__(self) -> None:
        if self.layer < 1 or not 0 <= self.drop_ratio < 1:
            raise ValueError(
                f"FastV needs layer >= 1 and drop_ratio in [0, 1), got {self.layer} and {self.drop_ratio}"
            )

    def kept(self, visual_tokens: int) -> int:
        """How many of ``visual_tokens`` stay; at least one."""
        return max(1, round(visual_tokens * (1 - self.drop_ratio)))


@dataclass(frozen=True)
class CloudOptions:
    """Choices of whoever runs the cloud half.

    Attributes:
        first_slot: which hidden states the head reads (see ``ActionConfig.first_slot``); None as configured.
        compact_positions: number the tokens that arrived 0, 1, 2, … in raster order, as VLA-ADP does, instead of
            leaving each where it was in the unpruned sequence.
        fastv: drop tokens inside the backbone; None for never.
        compile: run what the backbone does row by row through ``torch.compile``; the first calls are then slow, and
            a C++ compiler is needed on a CPU.
        noise_seed: of a diffusion head's starting noise; one request, one seed, one answer.
    """

    first_slot: int | None = None
    compact_positions: bool = False
    fastv: FastV | None = None
    compile: bool = False
    noise_seed: int = 0

    def describe(self) -> tuple[str, ...]:
        """Those choices that change answers, as the handshake tells them; empty where all are as configured."""
        words = []
        if self.first_slot is not None:
            words.append(f"first_slot={self.first_slot}")
        if self.compact_positions:
            words.append(COMPACT_POSITIONS)
        if self.fastv is not None:
            words.append(f"fastv={self.fastv.layer},{self.fastv.drop_ratio:g}")
        if self.noise_seed:
            words.append(f"noise_seed={self.noise_seed}")
        return tuple(words)
