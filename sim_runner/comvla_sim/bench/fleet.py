"""Many robots out of one event loop, cheap enough to overload a server on the same machine.

What a robot sends is encoded once, for every K: a call costs the generator joining two byte strings and one gRPC
call without any protobuf on the way out. Each robot has a connection and sessions of its own.
"""

from __future__ import annotations

import asyncio
import heapq
import math
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any

import grpc
import numpy as np

from comvla import codec, handshake
from comvla.load_hints import LoadHints
from comvla.model_info import PROTOCOL_VERSION, ModelInfo
from comvla.v1 import policy_pb2
from comvla_client.advice import BackOff, TokenAdvice

TIMEOUT_S = 60.0
_INSTRUCTION = "press the yellow button firmly"
_OPTIONS = (*codec.GRPC_OPTIONS, ("grpc.use_local_subchannel_pool", 1), ("grpc.enable_retries", 0))
_ENDINGS = {
    "OK": "answered",
    "RESOURCE_EXHAUSTED": "shed",
    "ABORTED": "superseded",
    "DEADLINE_EXCEEDED": "late",
}


@dataclass
class Tally:
    """What became of one robot's requests.

    Attributes:
        answered: within the deadline. late: let in, and not answered by then.
        shed: turned away. superseded: the robot asked anew first. failed: anything else.
        paused: not sent, because the robot backed off.
        tokens: sent with those that were answered.
        durations_s: of those that were answered.
        codes: of those that failed.
    """

    answered: int = 0
    late: int = 0
    shed: int = 0
    superseded: int = 0
    failed: int = 0
    paused: int = 0
    tokens: int = 0
    durations_s: list[float] = field(default_factory=list)
    codes: Counter[str] = field(default_factory=Counter)

    @property
    def offered(self) -> int:
        """Periods in which the robot wanted an answer."""
        settled = self.answered + self.late + self.shed + self.superseded + self.failed
        return settled + self.paused


class Fleet:
    """Robots of one server; an asynchronous context manager.

    Args:
        target: ``host:port``.
        robots: how many.
        tokens: K that each would like to send.
        follow_advice: whether they keep to the server's upper bound on K, as the client does.
        back_off: whether they pause after they were turned away, as the client does.
        seed: of tokens and times.
    """

    def __init__(
        self,
        target: str,
        *,
        robots: int,
        tokens: int,
        follow_advice: bool = False,
        back_off: bool = False,
        seed: int = 0,
    ) -> None:
        self._target = target
        self._tokens = tokens
        self._count = robots
        self._follow_advice, self._back_off = follow_advice, back_off
        self._rng = np.random.default_rng(seed)
        self._robots: list[_Robot] = []
        self._bodies: dict[int, bytes] = {}
        self._lives = 0

    async def __aenter__(self) -> Fleet:
        channels = [
            grpc.aio.insecure_channel(self._target, options=_OPTIONS) for _ in range(self._count)
        ]
        self._channels = channels
        info = await _model_of(channels[0])
        self._tokens = min(self._tokens, info.num_tokens)
        self._bodies = _bodies(info, self._tokens, self._rng)
        self._robots = [
            _Robot(f"robot-{i}", channel, self._bodies, info.num_tokens)
            for i, channel in enumerate(channels)
        ]
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for channel in self._channels:
            await channel.close()

    async def capacity(self, in_flight: int, seconds: float) -> float:
        """Answers per second where so many requests are always under way: the most that the server can do.

        The first quarter of the time is not counted. It takes longer where no answer came by then.
        """
        began = time.perf_counter()
        counted_from, until = began + 0.25 * seconds, began + seconds
        answers, last = 0, until

        async def keep_asking(robot: _Robot) -> None:
            nonlocal answers, last
            while time.perf_counter() < until or not answers:
                tally = Tally()
                await robot.ask(self._tokens, TIMEOUT_S, tally)
                if tally.failed or tally.late:
                    raise RuntimeError("a request was not answered while capacity was measured")
                now = time.perf_counter()
                if counted_from <= now < until or (now >= until and not answers):
                    answers += tally.answered
                    last = now

        self.begin(TIMEOUT_S)
        lanes = [self._robots[i % self._count].twin(i) for i in range(in_flight)]
        await asyncio.gather(*(keep_asking(lane) for lane in lanes))
        return answers / (max(until, last) - counted_from)

    async def offer(
        self,
        period_s: float,
        deadline_s: float,
        seconds: float,
        *,
        on_second: Callable[[float], None] | None = None,
    ) -> tuple[list[Tally], float]:
        """Every robot asks once a period, whatever became of what it asked before.

        Args:
            period_s: of each robot; its phase is drawn, and each query comes up to 10 % early or late.
            deadline_s: of each call.
            seconds: how long.
            on_second: told about once a second how many have passed.

        Returns:
            One tally per robot, and the 99th percentile of how late requests were sent, seconds.
        """
        tallies = [Tally() for _ in self._robots]
        began = time.perf_counter()
        until = began + seconds
        due = [(began + float(self._rng.random()) * period_s, i) for i in range(self._count)]
        heapq.heapify(due)
        under_way: set[asyncio.Task[None]] = set()
        lags_s: deque[float] = deque(maxlen=100_000)
        told = 0
        while due[0][0] < until:
            at, index = due[0]
            now = time.perf_counter()
            if on_second is not None and now - began > told + 1:
                told = int(now - began)
                on_second(now - began)
            if at > now:
                await asyncio.sleep(at - now)
                continue
            query = self._query(self._robots[index], deadline_s, tallies[index])
            task = asyncio.create_task(query)
            under_way.add(task)
            task.add_done_callback(under_way.discard)
            lags_s.append(now - at)
            jitter = 1.0 + 0.2 * (float(self._rng.random()) - 0.5)
            heapq.heapreplace(due, (at + jitter * period_s, index))
            if len(lags_s) % 16 == 0:
                await asyncio.sleep(0)  # a generator that lags behind must still hear its answers
        await asyncio.gather(*under_way)
        return tallies, float(np.percentile(lags_s, 99)) if lags_s else 0.0

    async def _query(self, robot: _Robot, deadline_s: float, tally: Tally) -> None:
        if self._back_off and robot.back_off.remaining_s > 0.0:
            tally.paused += 1
            return
        bound = robot.advice.most_tokens if self._follow_advice else None
        tokens = self._tokens if bound is None else min(self._tokens, bound)
        await robot.ask(tokens, deadline_s, tally)

    def begin(self, period_s: float) -> None:
        """New sessions of robots that ask once in so many seconds: nobody remembers what was before."""
        self._lives += 1
        for robot in self._robots:
            robot.begin(self._lives, period_s)


class _Robot:
    def __init__(
        self, name: str, channel: grpc.aio.Channel, bodies: dict[int, bytes], num_tokens: int
    ) -> None:
        self._name, self._channel, self._bodies = name, channel, bodies
        self._num_tokens = num_tokens
        # Bytes in and out: no message object on the way.
        self._infer: Any = channel.unary_unary("/comvla.v1.PolicyService/Infer")
        self.begin(0, TIMEOUT_S)

    def begin(self, life: int, period_s: float) -> None:
        self._session, self._step = f"{self._name}.{life}", 0
        self.advice = TokenAdvice(self._num_tokens)
        self.back_off = BackOff(period_s)

    def twin(self, number: int) -> _Robot:
        """Another robot over the same connection."""
        return _Robot(f"{self._session}.{number}", self._channel, self._bodies, self._num_tokens)

    async def ask(self, tokens: int, deadline_s: float, tally: Tally) -> None:
        """One request of K tokens; writes down what became of it."""
        head = policy_pb2.InferRequest(session_id=self._session, step=self._step)
        self._step += 1
        # Fields of one message may come in any number of parts: joined they are one request.
        message = head.SerializeToString() + self._bodies[tokens]
        began = time.perf_counter()
        try:
            answer: bytes = await self._infer(message, timeout=deadline_s)
        except grpc.aio.AioRpcError as error:
            code = error.code().name
            hints = LoadHints.from_metadata(error.trailing_metadata())
            self.advice.hear_refusal(hints.suggested_tokens)
            if code == "RESOURCE_EXHAUSTED":
                self.back_off.refused(hints.retry_after_s)
        else:
            # gRPC itself ends calls at their deadline: what arrived, arrived in time.
            code, took_s = "OK", time.perf_counter() - began
            response = policy_pb2.InferResponse.FromString(answer)
            self.advice.hear(response.load.suggested_tokens)
            self.back_off.answered()
            tally.tokens += response.tokens_used
            tally.durations_s.append(took_s)
        ending = _ENDINGS.get(code, "failed")
        if ending == "failed":
            tally.codes[code] += 1
        setattr(tally, ending, getattr(tally, ending) + 1)


def jain_index(shares: Sequence[float]) -> float:
    """Jain's index of fairness (1984): 1 where all have the same, 1/n where one has everything."""
    squares = sum(share * share for share in shares)
    return 1.0 if squares == 0.0 else sum(shares) ** 2 / (len(shares) * squares)


async def _model_of(channel: grpc.aio.Channel) -> ModelInfo:
    get_model = channel.unary_unary(
        "/comvla.v1.PolicyService/GetModel",
        request_serializer=policy_pb2.GetModelRequest.SerializeToString,
        response_deserializer=policy_pb2.GetModelResponse.FromString,
    )
    request = policy_pb2.GetModelRequest(protocol_version=PROTOCOL_VERSION)
    return handshake.from_response(await get_model(request, timeout=TIMEOUT_S))


def _bodies(info: ModelInfo, most: int, rng: np.random.Generator) -> dict[int, bytes]:
    """Requests without session and step, by K."""
    tokens = rng.standard_normal((most, info.token_dim), np.float32)
    positions = rng.permutation(info.num_tokens)[:most]
    bodies = {}
    for k in range(1, most + 1):
        request = policy_pb2.InferRequest(
            instruction=_INSTRUCTION,
            proprio=[0.0] * info.proprio_dim,
            payload=codec.encode(tokens[:k], positions[:k], "int8", tower_dims=info.tower_dims),
            model_fingerprint=info.fingerprint,
            protocol_version=PROTOCOL_VERSION,
        )
        bodies[k] = request.SerializeToString()
    return bodies


def percentile_s(durations_s: Sequence[float], percent: float) -> float:
    """A percentile of durations, NaN of none."""
    return float(np.percentile(durations_s, percent)) if durations_s else math.nan
