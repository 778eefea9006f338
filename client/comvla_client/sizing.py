"""How many tokens so many bits carry, counted as a client's ``budget`` says."""

from __future__ import annotations

from typing import Literal, Protocol, TypeAlias

from comvla import codec
from comvla.model_info import ModelInfo
from comvla.v1.policy_pb2 import InferRequest
from comvla_client.budget import LinkProfile, largest_that

Budget: TypeAlias = "Literal['paper', 'framed'] | int"
"""``"paper"``: Eq. (4). ``"framed"``: all bytes on the wire. A number: that many, whatever the SNR.

Tokens for a form that sends tokens, bytes for one that sends pictures.
"""


class Sizer(Protocol):
    """Turns bits into what an uplink form sends: tokens. Where it sends pictures, read bytes for tokens.

    Attributes:
        link: the radio link.
        num_tokens: all that there could be: N tokens.
        most_tokens: the most that a step may send: all, or a fixed budget.
        min_tokens: fewer are not worth sending.
        needs_snr: whether nothing can be sized without an SNR.
        sends_all: whether everything is sent, whatever the link carries.
    """

    @property
    def link(self) -> LinkProfile: ...

    @property
    def num_tokens(self) -> int: ...

    @property
    def most_tokens(self) -> int: ...

    @property
    def min_tokens(self) -> int: ...

    @property
    def needs_snr(self) -> bool: ...

    @property
    def sends_all(self) -> bool: ...

    def tokens_in(
        self, bits: float, request: InferRequest, *, progressive: bool, least: int, window_s: float
    ) -> int:
        """The tokens that ``bits`` carry, as ``budget`` counts; see :meth:`TokenSizer.tokens_in`."""
        ...

    def token_budgets(
        self, bits: float, request: InferRequest, *, progressive: bool, least: int, window_s: float
    ) -> tuple[int, int] | None:
        """K* by Eq. (4) and by bytes on the wire, for the report; None where no tokens are sent."""
        ...


class TokenSizer:
    """Turns bits into tokens for one model over one link.

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
        self.link = link
        self.min_tokens = min_tokens
        self.sends_all = sends_all
        self._info = info
        self._quantization = quantization
        self._budget = budget

    @property
    def num_tokens(self) -> int:
        """N."""
        return self._info.num_tokens

    @property
    def needs_snr(self) -> bool:
        """Whether nothing can be sized without an SNR."""
        return not (isinstance(self._budget, int) or self.sends_all)

    @property
    def most_tokens(self) -> int:
        """The most tokens that any step may send."""
        if isinstance(self._budget, int) and not self.sends_all:
            return min(self._budget, self._info.num_tokens)
        return self._info.num_tokens

    def tokens_in(
        self, bits: float, request: InferRequest, *, progressive: bool, least: int, window_s: float
    ) -> int:
        """The tokens that ``bits`` carry, as ``budget`` counts; not clipped to the N there are.

        Args:
            bits: capacity of the link.
            request: the request without its payload; its other fields take their share.
            progressive: whether the payload goes in pieces.
            least: tokens of the first piece.
            window_s: as the head of the stream says.
        """
        if isinstance(self._budget, int):
            return self._budget
        paper = self.paper_tokens(bits)
        if self._budget == "paper":
            return paper
        return self.framed_tokens(
            bits, request, progressive=progressive, least=least, window_s=window_s
        )

    def token_budgets(
        self, bits: float, request: InferRequest, *, progressive: bool, least: int, window_s: float
    ) -> tuple[int, int]:
        """K* of Eq. (4), and by all bytes that cross the wire; arguments as in :meth:`tokens_in`."""
        framed = self.framed_tokens(
            bits, request, progressive=progressive, least=least, window_s=window_s
        )
        return self.paper_tokens(bits), framed

    def paper_tokens(self, bits: float) -> int:
        """Eq. (4): D · B bits for each token."""
        return int(bits // (self._info.token_dim * codec.bits_per_value(self._quantization)))

    def framed_tokens(
        self, bits: float, request: InferRequest, *, progressive: bool, least: int, window_s: float
    ) -> int:
        """Tokens whose bytes all fit: positions, scales, protobuf, gRPC and HTTP/2 included."""
        room_bytes = bits / 8.0
        room_bytes -= codec.CALL_HEADERS_BYTES
        envelope = request.ByteSize()
        head = codec.progressive_head_bytes(envelope, window_s=window_s, min_tokens=least)

        def fits(k: int) -> bool:
            if progressive:
                ends = self.piece_ends(k, bits, least)
                return codec.progressive_wire_bytes(head, ends)[-1] <= room_bytes
            payload = self._encoded_bytes(k)
            # The payload is the one field that is not there yet.
            field = codec.infer_request_bytes(payload, snr=False, snr_age=False, protocol_version=0)
            return codec.wire_bytes(envelope + field) <= room_bytes

        return largest_that(fits, self.paper_tokens(bits))

    def piece_ends(self, k: int, bits: float, least: int) -> list[int]:
        """Where a payload of ``k`` tokens is cut for a link that carries about ``bits``."""
        dim, towers = self._info.token_dim, len(self._info.tower_dims)
        piece = codec.tokens_per_piece(bits / 8.0, dim, self._quantization, num_towers=towers)
        return codec.piece_ends(
            k,
            dim,
            self._quantization,
            num_towers=towers,
            first_tokens=least,
            piece_tokens=piece,
        )

    def _encoded_bytes(self, k: int) -> int:
        return codec.encoded_bytes(
            k, self._info.token_dim, self._quantization, num_towers=len(self._info.tower_dims)
        )


class ByteSizer:
    """Turns bits into bytes of pictures, which a form of pictures has in place of tokens.

    Args:
        link: the radio link.
        budget: ``"paper"`` counts the pictures' files, ``"framed"`` all bytes on the wire, a number fixes
            the bytes of the files.
        adjustable: whether the pictures' quality depends on what fits.

    Raises:
        ValueError: a budget that does not exist.
    """

    min_tokens = 1
    sends_all = False
    num_tokens = 2**31 - 1

    def __init__(self, link: LinkProfile, budget: Budget, *, adjustable: bool) -> None:
        is_count = isinstance(budget, int) and not isinstance(budget, bool) and budget >= 1
        if not is_count and budget not in ("paper", "framed"):
            raise ValueError(
                "expected budget 'paper' (bytes of the pictures), 'framed' (bytes on the wire) or a "
                f"number of bytes >= 1, got {budget!r}"
            )
        self.link = link
        self.needs_snr = adjustable and not is_count
        self._budget = budget

    @property
    def most_tokens(self) -> int:
        """The most bytes that any step may send."""
        return self._budget if isinstance(self._budget, int) else self.num_tokens

    def tokens_in(
        self, bits: float, request: InferRequest, *, progressive: bool, least: int, window_s: float
    ) -> int:
        """Bytes of pictures in so many bits; with ``"framed"`` bytes of the request's whole field."""
        if isinstance(self._budget, int):
            return self._budget
        room_bytes = int(bits // 8)
        if self._budget == "paper":
            return room_bytes
        rest = request.ByteSize()

        def fits(length: int) -> bool:
            field = codec.infer_request_bytes(
                0, snr=False, snr_age=False, protocol_version=0, images_length=length
            )
            return codec.wire_bytes(rest + field) + codec.CALL_HEADERS_BYTES <= room_bytes

        return largest_that(fits, room_bytes)

    def token_budgets(
        self, bits: float, request: InferRequest, *, progressive: bool, least: int, window_s: float
    ) -> None:
        """Pictures are no tokens."""
