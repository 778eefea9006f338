"""Why a call was not answered with actions."""

from __future__ import annotations

from enum import Enum

from comvla.errors import ComVLAError
from comvla_server.wording import one_line


class Reason(str, Enum):
    """Cause of a refusal; its value is the ``reason`` label of the metrics."""

    MALFORMED = "malformed"  # bytes that are no message of the contract
    INVALID = "invalid"  # shape, positions, non-finite values, instruction, proprioception
    CONFLICT = "conflict"  # a step that was already sent with other content
    UNKNOWN_MODEL = "unknown_model"  # a model by a name that nothing is served under
    MISMATCH = "mismatch"  # another model or another protocol
    OVERSIZE = "oversize"  # message larger than the cap
    OVERLOAD = "overload"  # queue full, or too many bytes in flight
    PREDICTED_LATE = "predicted_late"  # it, or one let in before, could not be answered in time
    CONGESTED = "congested"  # like predicted_late, told before the request was read
    FAIR_SHARE = "fair_share"  # too much is asked for, and this robot got more than others
    SHORT = "short"  # too few tokens of a payload in pieces arrived within its window
    KEY_FRAME = "key_frame"  # a picture that builds on one which is not held here
    SUPERSEDED = "superseded"  # a newer observation of the session came
    DEADLINE = "deadline"  # too late to be of use
    CANCELLED = "cancelled"  # the robot hung up
    LOADING = "loading"  # the model is not ready yet
    DRAINING = "draining"  # the server is stopping
    MODEL = "model"  # the model failed
    NO_IDENTITY = "no_identity"  # no token, or one that nobody has
    NOT_OWNER = "not_owner"  # the session of another identity
    RATE = "rate"  # more calls or bytes than this identity may send
    SLOW = "slow"  # the request did not arrive in time


class Refusal(ComVLAError):
    """A call that ends without actions; carries the reason and a message for the robot.

    Attributes:
        reason: the cause.
        message: one line that names what was expected, what came, and the remedy.
        retry_after_s: when to come back, seconds; None where waiting mends nothing that is known.
        suggested_tokens: as in the load hint of an answer, 0 for no wish.
    """

    def __init__(self, reason: Reason, message: str, *, retry_after_s: float | None = None) -> None:
        self.reason = reason
        self.retry_after_s = retry_after_s
        self.suggested_tokens = 0
        self.message = one_line(message)
        super().__init__(self.message)
