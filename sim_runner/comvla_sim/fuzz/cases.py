"""Which request a number stands for: the same one at any time, on any machine."""

from __future__ import annotations

import random
from dataclasses import dataclass

# Of every hundred numbers in a row, how many are of which kind, and where they go.
_SHARES = (
    ("fields", 52),
    ("bytes", 18),
    ("pictures", 5),
    ("streams", 6),
    ("memory", 3),
    ("valid", 2),
    ("socket fields", 6),
    ("socket bytes", 3),
    ("socket pictures", 1),
    ("socket streams", 1),
    ("frames", 3),
)
KINDS = tuple(name for name, share in _SHARES for _ in range(share))
assert len(KINDS) == 100, "shares are of a hundred"

DESCRIPTIONS = {
    "fields": "in process: one to three fields of a request replaced",
    "bytes": "in process: bytes of a serialised request changed",
    "pictures": "in process: coded pictures, with up to two things wrong",
    "streams": "in process: payloads in pieces",
    "memory": "in process, one by one: what a request with wrong fields allocates at most",
    "valid": "in process, between the others: nothing wrong, and the answer has to be right",
    "socket fields": "gRPC, to a server of its own",
    "socket bytes": "gRPC",
    "socket pictures": "gRPC",
    "socket streams": "gRPC",
    "frames": "a TCP connection each: HTTP/2 frames changed",
}

# Numbers are scattered, so that any stretch of them has every kind.
_STRIDE = 37


@dataclass(frozen=True)
class Case:
    """One request.

    Attributes:
        seed: of the run.
        number: within it.
    """

    seed: int
    number: int

    @property
    def kind(self) -> str:
        """A name of :data:`DESCRIPTIONS`."""
        return KINDS[self.number * _STRIDE % len(KINDS)]

    @property
    def in_process(self) -> bool:
        """Whether it is handed to the service directly."""
        return not self.kind.startswith("socket") and self.kind != "frames"

    def rng(self) -> random.Random:
        """What decides everything about it."""
        return random.Random(self.seed << 40 | self.number)

    def __str__(self) -> str:
        return f"{self.seed}:{self.number}"
