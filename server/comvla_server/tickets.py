"""One (session, step) on its way through the server, and what comes out of it."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from comvla_server.cost_model import Work
from comvla_server.refusals import Refusal
from comvla_vla.request import AnyRequest


@dataclass(frozen=True)
class Answer:
    """Actions and what they cost.

    Attributes:
        actions: (H, A) float32.
        tokens_used: K; N where pictures came.
        batch_size: requests that shared the forward pass.
        cloud_flops: multiply-adds counted twice, this request's share.
        queue_s: seconds between admission and the start of the forward pass.
        predict_s: seconds of the forward pass.
        ready_s: monotonic time when it was there.
    """

    actions: NDArray[np.float32]
    tokens_used: int
    batch_size: int
    cloud_flops: float
    queue_s: float
    predict_s: float
    ready_s: float


Outcome = Answer | Refusal


@dataclass(eq=False)
class Place:
    """A request as the queue sees it, whatever is in it.

    Attributes:
        robot: who asks: its identity where the server knows it, else its session.
        work: what it adds to a forward pass.
        deadline_s: monotonic time after which nobody waits any more.
        due_s: monotonic time by which the place is due: the deadline, or that of the older
            observation whose place it took.
    """

    robot: str
    work: Work
    deadline_s: float
    due_s: float


@dataclass(eq=False)
class Ticket:
    """A place in the queue; repeats of the same step share it.

    Attributes:
        session_id, step: identity of the request.
        digest: fingerprint of the request's content.
        request: what the model needs, or None once the outcome is there.
        place: where it stands; its deadline is the latest of all callers.
        admitted_s: monotonic time of admission.
        callers: calls that wait for the outcome right now.
        outcome: an answer or a refusal; never an exception, so that none goes unretrieved.
    """

    session_id: str
    step: int
    digest: bytes
    request: AnyRequest | None
    place: Place
    admitted_s: float
    outcome: asyncio.Future[Outcome]
    callers: int = field(default=0)

    def resolve(self, outcome: Outcome) -> None:
        """Settles the ticket once and lets go of the tokens or pictures."""
        self.request = None
        if not self.outcome.done():
            self.outcome.set_result(outcome)
