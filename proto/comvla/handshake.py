"""The handshake: what a server says about its model, and whether the robot's half belongs to it.

The server answers ``GetModel`` with :func:`to_response`. The robot reads that with
:func:`from_response`, which trusts nothing, and compares it with its own half by :func:`mismatch`
and :func:`quantization_mismatch` before it moves.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from comvla.codec import MAX_TOWERS
from comvla.errors import HandshakeError
from comvla.images import coding_name, coding_number
from comvla.model_info import PROTOCOL_VERSION, ModelInfo
from comvla.v1 import policy_pb2

COMPACT_POSITIONS = "compact_positions"
"""Run option of a server that numbers the tokens that arrive 0, 1, 2, …"""

_ENUM_PREFIX = "QUANTIZATION_"
_LONGEST_TEXT = 200
_MOST_OPTIONS = 32
_LARGEST_SIZE = 65_535  # of anything counted: tokens, dimensions, actions, pixels

# In the order told: widths explain a difference better than fingerprints do.
_COMPARED = (
    "token_dim",
    "tower_dims",
    "num_tokens",
    "grid",
    "image_size",
    "action_dim",
    "action_horizon",
    "proprio_dim",
    "max_prompt_tokens",
    "delta_actions",
    "control_period_s",
)


def to_response(
    info: ModelInfo,
    *,
    quantizations: Sequence[str],
    max_request_bytes: int,
    server_version: str,
    image_codings: Sequence[str] = (),
    progressive: bool = False,
    run_options: Sequence[str] = (),
    edge_fingerprints: Sequence[str] = (),
) -> policy_pb2.GetModelResponse:
    """The server's answer to ``GetModel``.

    Args:
        info: the model that the server runs.
        quantizations: names of :data:`comvla.codec.QUANTIZATIONS` that it reads.
        max_request_bytes: largest ``InferRequest`` that it reads.
        server_version: release, for people.
        image_codings: names of :data:`comvla.images.IMAGE_CODINGS` that it reads; none where the
            robot has to see for itself.
        progressive: whether it answers ``InferProgressive``.
        run_options: how the model is run where that changes its answers, e.g. :data:`COMPACT_POSITIONS`.
        edge_fingerprints: of other models with the same edge half, whose robots are answered too.

    Raises:
        ValueError: a quantization or picture coding that the protocol does not know.
    """
    return policy_pb2.GetModelResponse(
        protocol_version=PROTOCOL_VERSION,
        model_name=info.name,
        model_fingerprint=info.fingerprint,
        num_tokens=info.num_tokens,
        token_dim=info.token_dim,
        tower_dims=info.tower_dims,
        grid=info.grid,
        action_horizon=info.action_horizon,
        action_dim=info.action_dim,
        proprio_dim=info.proprio_dim,
        max_prompt_tokens=info.max_prompt_tokens,
        delta_actions=info.delta_actions,
        control_period_s=info.control_period_s,
        quantizations=[_ENUM_PREFIX + name.upper() for name in quantizations],
        max_request_bytes=max_request_bytes,
        server_version=server_version,
        image_size=info.image_size,
        image_codings=[coding_number(name) for name in image_codings],
        progressive=progressive,
        run_options=run_options,
        edge_fingerprints=edge_fingerprints,
    )


def from_response(response: policy_pb2.GetModelResponse) -> ModelInfo:
    """What the server says about its model, checked: a stranger may have answered.

    Raises:
        HandshakeError: another protocol version, or a description that contradicts itself.
    """
    if response.protocol_version != PROTOCOL_VERSION:
        raise HandshakeError(
            f"client speaks protocol version {PROTOCOL_VERSION}, server answers with "
            f"{response.protocol_version}: install the same ComVLA on both sides "
            "(0 means that this is not a ComVLA server)"
        )
    _require(_is_text(response.model_name), "model_name", "printable text", response.model_name)
    fingerprint = response.model_fingerprint
    _require(_is_text(fingerprint), "model_fingerprint", "printable text", fingerprint)
    for name in ("num_tokens", "token_dim", "action_horizon", "action_dim", "max_prompt_tokens"):
        size = getattr(response, name)
        _require(1 <= size <= _LARGEST_SIZE, name, f"1 to {_LARGEST_SIZE}", size)
    proprio_dim, period_s = response.proprio_dim, response.control_period_s
    _require(proprio_dim <= _LARGEST_SIZE, "proprio_dim", f"0 to {_LARGEST_SIZE}", proprio_dim)
    _require(0 < period_s < math.inf, "control_period_s", "a positive time", period_s)

    towers = tuple(response.tower_dims)
    _require(
        1 <= len(towers) <= MAX_TOWERS and min(towers) > 0 and sum(towers) == response.token_dim,
        "tower_dims",
        f"1 to {MAX_TOWERS} widths that sum to token_dim {response.token_dim}",
        towers,
    )
    grid = tuple(response.grid)
    _require(
        len(grid) == 3 and math.prod(grid) == response.num_tokens,
        "grid",
        f"views, rows and columns whose product is num_tokens {response.num_tokens}",
        grid,
    )
    image_size = tuple(response.image_size)
    _require(
        len(image_size) == 2 and all(1 <= pixels <= _LARGEST_SIZE for pixels in image_size),
        "image_size",
        "height and width in pixels",
        image_size,
    )
    _require(
        len(response.delta_actions) == response.action_dim,
        "delta_actions",
        f"one for each of {response.action_dim} action dimensions",
        tuple(response.delta_actions),
    )
    return ModelInfo(
        name=response.model_name,
        fingerprint=response.model_fingerprint,
        num_tokens=response.num_tokens,
        token_dim=response.token_dim,
        tower_dims=towers,
        grid=(grid[0], grid[1], grid[2]),
        image_size=(image_size[0], image_size[1]),
        action_horizon=response.action_horizon,
        action_dim=response.action_dim,
        proprio_dim=response.proprio_dim,
        max_prompt_tokens=response.max_prompt_tokens,
        delta_actions=tuple(response.delta_actions),
        control_period_s=response.control_period_s,
    )


def offered_quantizations(response: policy_pb2.GetModelResponse) -> tuple[str, ...]:
    """Names of the payload codings that the server reads; those newer than this side are left out."""
    known = {number: name for name, number in policy_pb2.Quantization.items() if number}
    return tuple(
        known[number].removeprefix(_ENUM_PREFIX).lower()
        for number in response.quantizations
        if number in known
    )


def offered_image_codings(response: policy_pb2.GetModelResponse) -> tuple[str, ...]:
    """Names of the picture codings that the server reads; those newer than this side are left out."""
    names = (coding_name(number) for number in response.image_codings)
    return tuple(name for name in names if name is not None)


def run_options(response: policy_pb2.GetModelResponse) -> tuple[str, ...]:
    """How the server runs its model where that changes answers; what is no plain text is left out."""
    return tuple(option for option in response.run_options[:_MOST_OPTIONS] if _is_text(option))


def edge_fingerprints(response: policy_pb2.GetModelResponse) -> tuple[str, ...]:
    """Fingerprints of other models with the same edge half, whose robots the server answers too."""
    return tuple(text for text in response.edge_fingerprints[:_MOST_OPTIONS] if _is_text(text))


def mismatch(edge: ModelInfo, cloud: ModelInfo, also: Iterable[str] = ()) -> str | None:
    """The first difference between the robot's half and the server's, in words with a remedy.

    Sizes come before the fingerprint, because they say more. Names may differ: one checkpoint can
    lie in two folders.

    Args:
        edge: the robot's half.
        cloud: the server's.
        also: fingerprints that will do as well as the server's own (:func:`edge_fingerprints`).

    Returns:
        None where the halves belong together.
    """
    for field in _COMPARED:
        expected, came = getattr(cloud, field), getattr(edge, field)
        if expected != came:
            return (
                f"server expects {field} {_words(expected)} ({cloud.name}), client sends "
                f"{_words(came)} ({edge.name}): load the edge half of the same checkpoint"
            )
    if edge.fingerprint not in (cloud.fingerprint, *also):
        return (
            f"server expects fingerprint {cloud.fingerprint} ({cloud.name}), client sends "
            f"{edge.fingerprint} ({edge.name}): the sizes agree, the weights do not; load the edge "
            "half of the same checkpoint"
        )
    return None


def quantization_mismatch(wanted: str, offered: Iterable[str]) -> str | None:
    """Whether the server reads what the robot wants to send; in words with a remedy if not."""
    names = tuple(offered)
    if wanted in names:
        return None
    return (
        f"server reads quantization {', '.join(names) or 'none known here'}, client sends "
        f"{wanted}: choose one that the server reads"
    )


def image_coding_mismatch(wanted: str, offered: Iterable[str]) -> str | None:
    """Whether the server reads the pictures that the robot wants to send; in words if not."""
    names = tuple(offered)
    if wanted in names:
        return None
    if not names:
        return (
            f"client sends {wanted} pictures, server has no vision half and reads tokens only: start "
            "it with comvla-server serve --vision on, or give the robot an edge model"
        )
    return (
        f"server reads pictures as {', '.join(names)}, client sends {wanted}: choose one that the "
        "server reads, or install what it lacks there (pillow for jpeg, webp and avif, av for h264)"
    )


def _require(sound: bool, name: str, wanted: str, value: object) -> None:
    if not sound:
        raise HandshakeError(
            f"expected {name} as {wanted}, got {value!r:.{_LONGEST_TEXT}}: the server describes a "
            "model that cannot be; check the address and the server's version"
        )


def _is_text(value: str) -> bool:
    return 0 < len(value) <= _LONGEST_TEXT and value.isprintable()


def _words(value: object) -> str:
    return str(list(value)) if isinstance(value, tuple) else str(value)
