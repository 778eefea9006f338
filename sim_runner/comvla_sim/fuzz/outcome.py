"""What became of the requests, and what must not have."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import grpc

from comvla_server.statuses import STATUS

# What a stranger's request may be answered with. INTERNAL and UNAVAILABLE would be the server's own
# fault, and nobody here is asked for a token.
ALLOWED = frozenset({grpc.StatusCode.OK, *STATUS.values()}) - {
    grpc.StatusCode.INTERNAL,
    grpc.StatusCode.UNAVAILABLE,
    grpc.StatusCode.UNAUTHENTICATED,
    grpc.StatusCode.PERMISSION_DENIED,
}

_SHOWN = 20


@dataclass
class Tally:
    """Counts over cases.

    Attributes:
        kinds: cases by kind.
        statuses: how they ended, by kind and name of the status (or of the end of a connection).
        failures: cases that ended as none may, and how; the first of them.
        failed: how many there were.
        words: of the refusal that came last.
    """

    kinds: Counter[str] = field(default_factory=Counter)
    statuses: dict[str, Counter[str]] = field(default_factory=dict)
    failures: list[dict[str, str]] = field(default_factory=list)
    failed: int = 0
    words: str = ""

    def ended(self, kind: str, status: str) -> None:
        """One case is over."""
        self.kinds[kind] += 1
        self.statuses.setdefault(kind, Counter())[status] += 1

    def fail(self, case: object, kind: str, what: str) -> None:
        """One case ended as none may."""
        self.failed += 1
        if len(self.failures) < _SHOWN:
            self.failures.append({"case": str(case), "kind": kind, "what": what[:500]})

    def judge(self, case: object, kind: str, code: grpc.StatusCode, message: str) -> None:
        """One case was answered with a status and words."""
        self.ended(kind, code.name)
        self.words = message
        if code not in ALLOWED:
            self.fail(case, kind, f"answered {code.name}: {message}")
        elif code is not grpc.StatusCode.OK and not (message and message.isprintable()):
            self.fail(case, kind, f"answered {code.name} with words {message!r}")

    def to_dict(self) -> dict[str, Any]:
        """As JSON."""
        return {
            "kinds": dict(self.kinds),
            "statuses": {kind: dict(counts) for kind, counts in self.statuses.items()},
            "failures": self.failures,
            "failed": self.failed,
            "words": self.words,
        }

    def add(self, other: dict[str, Any]) -> None:
        """Joins another one, as JSON."""
        self.kinds.update(other["kinds"])
        for kind, counts in other["statuses"].items():
            self.statuses.setdefault(kind, Counter()).update(counts)
        self.failures = [*self.failures, *other["failures"]][:_SHOWN]
        self.failed += other["failed"]
        self.words = other["words"]
