"""Tokens up the link: encode, score, select, quantise (Algorithm 1)."""

from __future__ import annotations

import logging
import time

import numpy as np

from comvla import codec, handshake
from comvla.errors import HandshakeError
from comvla.v1.policy_pb2 import GetModelResponse
from comvla_client.arrays import Array, to_numpy
from comvla_client.observation import CheckedObservation
from comvla_client.selection import ScoringContext, Selector
from comvla_client.sizing import TokenSizer
from comvla_client.uplink import Setup, Uplink

_log = logging.getLogger(__name__)


class TokenUplink:
    """The most important tokens, as many as the link carries (Algorithm 1).

    Args:
        selector: who ranks the tokens.
        name: for reports; the selector's class by default.
    """

    def __init__(self, selector: Selector, name: str | None = None) -> None:
        self.selector = selector
        self.name = name or type(selector).__name__
        self._instruction: str | None = None
        self._queries: Array | None = None

    @property
    def needs_edge(self) -> bool:
        """Always: only the robot's half of the model makes tokens."""
        return True

    @property
    def in_pieces(self) -> bool:
        """Always: every prefix of a payload is a smaller payload."""
        return True

    def start(self, setup: Setup) -> None:
        """Learns who the robot is.

        Raises:
            ValueError: an option out of range.
        """
        assert setup.edge is not None, "a form that needs the edge model gets it"
        self._edge, self._quantization = setup.edge, setup.quantization
        self.sizer = TokenSizer(
            setup.info,
            setup.link,
            setup.quantization,
            setup.budget,
            sends_all=self.selector.sends_all,
            min_tokens=setup.min_tokens,
        )

    def check_server(self, response: GetModelResponse) -> None:
        """Quantization and size of the largest request; warns where the server does not run as the selector wants.

        Raises:
            HandshakeError: the server does not read them.
        """
        offered = handshake.offered_quantizations(response)
        difference = handshake.quantization_mismatch(self._quantization, offered)
        if difference is not None:
            raise HandshakeError(difference)
        info, most_tokens = self._edge.info, self.sizer.most_tokens
        largest_bytes = codec.request_wire_bytes(
            most_tokens, info.token_dim, self._quantization, num_towers=len(info.tower_dims)
        )
        if response.max_request_bytes and largest_bytes > response.max_request_bytes:
            raise HandshakeError(
                f"server reads requests of at most {response.max_request_bytes} bytes, {most_tokens} "
                f"{self._quantization} tokens take {largest_bytes}: raise the server's cap, fix a "
                "smaller budget, or use a coarser quantization"
            )

        options = handshake.run_options(response)
        for wanted in getattr(self.selector, "wants_run_options", ()):
            if wanted not in options:
                _log.warning(
                    "%s was made for servers with %s, this one runs with %s: actions will differ from the "
                    "published method's; start it with `comvla-server serve --%s`",
                    self.name,
                    wanted,
                    ", ".join(options) or "no options",
                    wanted.replace("_", "-"),
                )

    def hear(self, instruction: str) -> None:
        """Embeds the words when the instruction changes.

        Raises:
            InstructionError: the model cannot read it.
        """
        self.queries(instruction)

    def queries(self, instruction: str) -> Array:
        """Language queries (Q, d), computed when the instruction changes.

        Raises:
            InstructionError: the model cannot read it.
        """
        if self._queries is None or instruction != self._instruction:
            self._queries = self._edge.text_queries(instruction)
            self._instruction = instruction
        return self._queries

    def settle(self, step: int, answered: bool) -> None:
        """Tokens stand alone: nothing depends on what was lost."""

    def reset(self) -> None:
        """Begins a new episode, for selectors with a memory."""
        forget = getattr(self.selector, "reset", None)
        if forget is not None:
            forget()

    def compress(self, obs: CheckedObservation, count: int, rng: np.random.Generator) -> Uplink:
        """Encodes an observation and keeps the ``count`` most important tokens.

        Args:
            obs: a checked observation.
            count: K, 1 to N; a selector that ranks fewer sends fewer.
            rng: for selectors that draw.
        """
        assert self._queries is not None, "hear() comes first"
        info, timings_s = self._edge.info, {}
        watch = _Stopwatch()
        if getattr(self._edge, "sees_instruction", False):
            tokens = self._edge.encode(obs.images, self._instruction)  # type: ignore[call-arg]
        else:
            tokens = self._edge.encode(obs.images)
        timings_s["encode"] = watch.lap()
        uses_language = self.selector.uses_language
        projected = self._edge.project(tokens) if uses_language else None
        timings_s["project"] = watch.lap()
        context = ScoringContext(
            tokens,
            projected,
            self._queries,
            info.grid,
            rng,
            edge=self._edge,
            instruction=self._instruction,
            proprio=obs.proprio,
        )
        ranking = self.selector.rank(context)
        timings_s["score"] = watch.lap()
        positions = np.ascontiguousarray(ranking[:count], dtype=np.int32)
        kept = to_numpy(tokens[positions], np.float32)
        timings_s["select"] = watch.lap()
        payload = codec.encode(kept, positions, self._quantization, tower_dims=info.tower_dims)
        timings_s["quantize"] = watch.lap()
        return Uplink(
            payload=payload,
            positions=positions,
            payload_bytes=codec.payload_bytes(len(positions), info.token_dim, self._quantization),
            timings_s=timings_s,
            flops=float(self._edge.flops(self._queries.shape[0] if uses_language else 0)),
        )


class _Stopwatch:
    """Seconds since the last lap on the monotonic clock."""

    def __init__(self) -> None:
        self._last = time.perf_counter()

    def lap(self) -> float:
        now = time.perf_counter()
        elapsed, self._last = now - self._last, now
        return elapsed
