"""What must hold before a request may cost compute."""

from __future__ import annotations

import hashlib
import math
import re
import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from comvla import codec
from comvla.errors import CodecError, InstructionError
from comvla.model_info import PROTOCOL_VERSION
from comvla.v1 import policy_pb2
from comvla_server.decoding import read_pictures
from comvla_server.engine import Engine
from comvla_server.refusals import Reason, Refusal
from comvla_server.wording import shown
from comvla_vla.request import AnyRequest, ImageRequest, PolicyRequest

MAX_SESSION_ID_CHARS = 128
MAX_INSTRUCTION_CHARS = 2000
# What float16, the narrowest floating-point coding of the contract, can hold. Larger values are
# finite but overflow inside a model.
MAX_ABS_VALUE = 65504.0

SESSION_ID = re.compile(rf"[A-Za-z0-9][A-Za-z0-9._:@/+=-]{{0,{MAX_SESSION_ID_CHARS - 1}}}")


@dataclass(frozen=True)
class Validator:
    """Checks requests against the model; refusals name what was expected, what came, the remedy.

    Attributes:
        engine: the model that will run.
        max_request_bytes: largest message, bytes.
        also: fingerprints of other models with the same edge half, whose robots are answered too.
    """

    engine: Engine
    max_request_bytes: int
    also: frozenset[str] = frozenset()

    def check_identity(self, request: policy_pb2.InferRequest) -> None:
        """Size, protocol, model, session and lengths: what can be told without reading the content.

        Raises:
            Refusal: oversize, mismatch or invalid.
        """
        size = request.ByteSize()
        if size > self.max_request_bytes:
            raise Refusal(
                Reason.OVERSIZE,
                f"expected a request of at most {self.max_request_bytes} bytes, got {size}: "
                "send fewer tokens or a narrower quantization, or raise --max-request-bytes",
            )
        if request.protocol_version != PROTOCOL_VERSION:
            raise Refusal(
                Reason.MISMATCH,
                f"server speaks protocol version {PROTOCOL_VERSION}, the request says "
                f"{request.protocol_version}: install the same comvla release on robot and server",
            )
        info = self.engine.info
        if request.model_fingerprint not in (info.fingerprint, *self.also):
            raise Refusal(
                Reason.MISMATCH,
                f"server runs {info.name} with fingerprint {shown(info.fingerprint)}, the request "
                f"says {shown(request.model_fingerprint)}: "
                "load the edge half of the same checkpoint",
            )
        if not SESSION_ID.fullmatch(request.session_id):
            raise Refusal(
                Reason.INVALID,
                f"expected a session_id of 1 to {MAX_SESSION_ID_CHARS} letters, digits or ._:@/+=- "
                f"that begins with a letter or digit, got {shown(request.session_id)}: "
                "a UUID is a good choice",
            )
        self._check_lengths(request)

    def check_head(self, request: policy_pb2.InferRequest) -> None:
        """All that can be told before the first token, so that no robot sends tokens for nothing.

        Raises:
            Refusal: oversize, mismatch or invalid.
        """
        self.check_identity(request)
        self._check_link_report(request)
        self._check_instruction(request.instruction)
        self._proprio(request)

    def read(self, request: policy_pb2.InferRequest) -> AnyRequest:
        """Checks the content and decodes tokens or pictures.

        Pictures take milliseconds to decode: call it off the event loop where ``images`` is set.

        Returns:
            What the model needs: tokens (K, D) float32, 1 <= K <= N, and positions (K,) int32; or pictures.

        Raises:
            Refusal: invalid; for pictures also mismatch or key frame.
        """
        self._check_link_report(request)
        self._check_instruction(request.instruction)
        proprio = self._proprio(request)
        if request.HasField("images"):
            pictures = read_pictures(request, self.engine.info, self.engine.vision)
            return ImageRequest(pictures, request.instruction, proprio)
        tokens, positions = self._tokens(request.payload)
        return PolicyRequest(tokens, positions, request.instruction, proprio)

    def _check_link_report(self, request: policy_pb2.InferRequest) -> None:
        if request.HasField("snr_db") and not math.isfinite(request.snr_db):
            raise _invalid(
                f"expected a finite snr_db, got {request.snr_db}: leave the field unset where no "
                "report exists"
            )
        age_s = request.snr_age_s
        if request.HasField("snr_age_s") and not (math.isfinite(age_s) and age_s >= 0):
            raise _invalid(
                f"expected a finite snr_age_s of at least 0 seconds, got {age_s}: take it from a "
                "monotonic clock"
            )

    def _check_lengths(self, request: policy_pb2.InferRequest) -> None:
        """Bounds the work of everything that follows, the digest first of all."""
        if len(request.instruction) > MAX_INSTRUCTION_CHARS:
            raise _invalid(
                f"expected an instruction of at most {MAX_INSTRUCTION_CHARS} characters, got "
                f"{len(request.instruction)}: say it in fewer words"
            )
        info, came = self.engine.info, len(request.proprio)
        if came != info.proprio_dim:
            raise _invalid(
                f"expected {info.proprio_dim} proprioception values, got {came}: send the raw "
                f"vector that {info.name} was trained with"
                if info.proprio_dim
                else f"expected no proprioception, got {came} values: {info.name} takes none"
            )

    def _check_instruction(self, instruction: str) -> None:
        try:
            self.engine.check_instruction(instruction)
        except InstructionError as error:
            raise _invalid(f"instruction {shown(instruction)}: {error}") from error

    def _proprio(self, request: policy_pb2.InferRequest) -> NDArray[np.float32] | None:
        if not self.engine.info.proprio_dim:
            return None
        proprio = np.asarray(request.proprio, dtype=np.float32)
        _check_values(proprio, "proprioception")
        return proprio

    def _tokens(self, payload: bytes) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
        info = self.engine.info
        try:
            tokens, positions = codec.decode(
                payload,
                max_tokens=info.num_tokens,
                token_dim=info.token_dim,
                num_tokens=info.num_tokens,
            )
        except CodecError as error:
            raise _invalid(f"payload: {error}") from error
        if len(positions) == 0:
            raise _invalid(
                f"expected 1 to {info.num_tokens} tokens, got none: "
                "where the link carries no token, act on the rest of the last chunk"
            )
        _check_values(tokens, "tokens")
        return tokens, positions


def content_digest(request: policy_pb2.InferRequest) -> bytes:
    """16 bytes over what decides the answer; a retry has the same, whatever its SNR report."""
    digest = hashlib.blake2b(digest_size=16)
    text = request.instruction.encode()
    digest.update(struct.pack("<QQ", len(text), len(request.proprio)))
    digest.update(text)
    digest.update(np.asarray(request.proprio, dtype="<f4").tobytes())
    digest.update(request.payload)
    if request.HasField("images"):
        digest.update(request.images.SerializeToString(deterministic=True))
    return digest.digest()


def _check_values(values: NDArray[np.float32], what: str) -> None:
    # One pass over the array: a NaN makes the comparison False as well.
    largest = float(np.abs(values).max())
    if not largest <= MAX_ABS_VALUE:
        raise _invalid(
            f"expected finite {what} of at most {MAX_ABS_VALUE:g} in size, got {largest:g}: "
            "check the sensor or the edge half for overflow"
        )


def _invalid(message: str) -> Refusal:
    return Refusal(Reason.INVALID, message)
