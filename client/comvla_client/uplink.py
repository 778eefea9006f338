"""From an observation to the bytes that cross the link: encode, score, select, quantise."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from comvla import codec
from comvla_client.arrays import Array, to_numpy
from comvla_client.edge import EdgeModel
from comvla_client.observation import CheckedObservation
from comvla_client.selection import ScoringContext, Selector


@dataclass(frozen=True)
class Uplink:
    """Tokens ready to send.

    Attributes:
        payload: coded tokens, most important first.
        positions: (K,) int32.
        timings_s: seconds of the phases encode, project, score, select, quantize.
        flops: operations on the robot.
    """

    payload: bytes
    positions: npt.NDArray[np.int32]
    timings_s: dict[str, float]
    flops: float


class TokenUplink:
    """The edge half of one step (Algorithm 1 after the link budget is known).

    Args:
        edge: the robot's half of the model.
        selector: who ranks the tokens.
        quantization: how values are coded, a name of :data:`comvla.codec.QUANTIZATIONS`.
    """

    def __init__(self, edge: EdgeModel, selector: Selector, quantization: str) -> None:
        self._edge = edge
        self._selector = selector
        self._quantization = quantization
        self._instruction: str | None = None
        self._queries: Array | None = None

    def queries(self, instruction: str) -> Array:
        """Language queries (Q, d), computed when the instruction changes.

        Raises:
            InstructionError: the model cannot read it.
        """
        if self._queries is None or instruction != self._instruction:
            self._queries = self._edge.text_queries(instruction)
            self._instruction = instruction
        return self._queries

    def reset(self) -> None:
        """Begins a new episode, for selectors with a memory."""
        forget = getattr(self._selector, "reset", None)
        if forget is not None:
            forget()

    def compress(
        self, obs: CheckedObservation, queries: Array, count: int, rng: np.random.Generator
    ) -> Uplink:
        """Encodes an observation and keeps the ``count`` most important tokens.

        Args:
            obs: a checked observation.
            queries: (Q, d) language queries.
            count: K, 1 to N; a selector that ranks fewer sends fewer.
            rng: for selectors that draw.
        """
        info, timings_s = self._edge.info, {}
        watch = _Stopwatch()
        if getattr(self._edge, "sees_instruction", False):
            tokens = self._edge.encode(obs.images, self._instruction)  # type: ignore[call-arg]
        else:
            tokens = self._edge.encode(obs.images)
        timings_s["encode"] = watch.lap()
        uses_language = self._selector.uses_language
        projected = self._edge.project(tokens) if uses_language else None
        timings_s["project"] = watch.lap()
        context = ScoringContext(
            tokens,
            projected,
            queries,
            info.grid,
            rng,
            edge=self._edge,
            instruction=self._instruction,
            proprio=obs.proprio,
        )
        ranking = self._selector.rank(context)
        timings_s["score"] = watch.lap()
        positions = np.ascontiguousarray(ranking[:count], dtype=np.int32)
        kept = to_numpy(tokens[positions], np.float32)
        timings_s["select"] = watch.lap()
        payload = codec.encode(kept, positions, self._quantization, tower_dims=info.tower_dims)
        timings_s["quantize"] = watch.lap()
        flops = float(self._edge.flops(queries.shape[0] if uses_language else 0))
        return Uplink(payload, positions, timings_s, flops)


class _Stopwatch:
    """Seconds since the last lap on the monotonic clock."""

    def __init__(self) -> None:
        self._last = time.perf_counter()

    def lap(self) -> float:
        now = time.perf_counter()
        elapsed, self._last = now - self._last, now
        return elapsed
