"""How many tokens a step sends: the link's budget, clipped to what there is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

from comvla import codec
from comvla.errors import LinkError
from comvla.model_info import ModelInfo
from comvla.v1.policy_pb2 import InferRequest
from comvla_client.budget import LinkProfile, framed_token_budget, token_budget
from comvla_client.snr import SnrReading

Budget: TypeAlias = "Literal['paper', 'framed'] | int"
"""``"paper"``: Eq. (4). ``"framed"``: all bytes on the wire. A number: that many, whatever the SNR."""


@dataclass(frozen=True)
class Size:
    """The size of one step's payload.

    Attributes:
        budget: K*, not clipped.
        count: tokens to send; 0 means send nothing.
        capacity_bits: C_link of Eq. (1); None where no SNR is known.
    """

    budget: int
    count: int
    capacity_bits: float | None


class TokenSizer:
    """Sizes payloads for one model over one link.

    Args:
        info: the model.
        link: the radio link.
        quantization: how values are coded.
        budget: see :data:`Budget`.
        sends_all: the selector sends all N tokens, whatever the budget.
        min_tokens: fewer than this are useless to the policy and not sent.

    Raises:
        ValueError: a quantization, budget or minimum that does not exist.
    """

    def __init__(
        self,
        info: ModelInfo,
        link: LinkProfile,
        quantization: str,
        budget: Budget,
        *,
        sends_all: bool,
        min_tokens: int,
    ) -> None:
        if quantization not in codec.QUANTIZATIONS:
            raise ValueError(
                f"expected a quantization among {', '.join(codec.QUANTIZATIONS)}, got "
                f"{quantization!r}"
            )
        is_count = isinstance(budget, int) and not isinstance(budget, bool) and budget >= 1
        if not is_count and budget not in ("paper", "framed"):
            raise ValueError(
                "expected budget 'paper' (Eq. (4)), 'framed' (bytes on the wire) or a number of "
                f"tokens >= 1, got {budget!r}"
            )
        if not 1 <= min_tokens <= info.num_tokens:
            raise ValueError(
                f"expected min_tokens in 1 to {info.num_tokens} (tokens of {info.name}), got "
                f"{min_tokens}"
            )
        self._info = info
        self._link = link
        self._quantization = quantization
        self._budget = budget
        self._sends_all = sends_all
        self._min_tokens = min_tokens

    @property
    def needs_snr(self) -> bool:
        """Whether a step cannot be sized without an SNR."""
        return not (isinstance(self._budget, int) or self._sends_all)

    @property
    def most_tokens(self) -> int:
        """The most tokens that any step may send."""
        if isinstance(self._budget, int) and not self._sends_all:
            return min(self._budget, self._info.num_tokens)
        return self._info.num_tokens

    def size(self, reading: SnrReading | None, request: InferRequest) -> Size:
        """How many tokens to send now.

        Args:
            reading: the link's SNR, None where nobody knows it.
            request: the request without its payload; its other fields take their share of the link.

        Raises:
            LinkError: the budget depends on the SNR and there is none.
        """
        if reading is None:
            if self.needs_snr:
                raise LinkError(
                    f"budget={self._budget!r} sizes the payload by the SNR, and none is known: pass "
                    "step(..., snr=dB), give the client an snr source, or fix it with budget=K"
                )
            return Size(self.most_tokens, self.most_tokens, None)
        capacity_bits = self._link.capacity_bits(reading.snr_db)
        budget = self._token_budget(reading, request)
        count = self._info.num_tokens if self._sends_all else min(budget, self._info.num_tokens)
        # At −inf dB there is no link at all, whatever a fixed budget or a selector says.
        sendable = capacity_bits > 0.0 and count >= self._min_tokens
        return Size(budget, count if sendable else 0, capacity_bits)

    def _token_budget(self, reading: SnrReading, request: InferRequest) -> int:
        if isinstance(self._budget, int):
            return self._budget
        info = self._info
        if self._budget == "paper":
            bits_per_token = info.token_dim * codec.bits_per_value(self._quantization)
            return token_budget(reading.snr_db, self._link, bits_per_token)
        return framed_token_budget(
            reading.snr_db,
            self._link,
            token_dim=info.token_dim,
            quantization=self._quantization,
            num_towers=len(info.tower_dims),
            session_id=request.session_id,
            step=request.step,
            instruction=request.instruction,
            proprio_dim=info.proprio_dim,
            model_fingerprint=request.model_fingerprint,
        )
