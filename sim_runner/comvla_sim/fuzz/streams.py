"""Streams of pieces in which something is wrong: the head, the order, the lengths, the end."""

from __future__ import annotations

import math
import random

from comvla.v1 import policy_pb2
from comvla_sim.fuzz.mutations import mutated_bytes, mutated_fields, plain_request

WINDOWS_S = (0.02, 0.02, 0.02, 0.001, 0.0, -1.0, 1e-30, 10.1, 1e9, math.nan, math.inf)


def mutated_stream(rng: random.Random) -> list[bytes]:
    """The serialised messages of one stream."""
    request = plain_request(rng)
    content = request.payload
    request.ClearField("payload")
    head = policy_pb2.InferProgressiveRequest()
    head.head.window_s = rng.choice(WINDOWS_S)
    head.head.min_tokens = rng.choice((0, 0, 0, 1, 4, 128, 129, 2**32 - 1))
    if rng.random() < 0.2:
        request = policy_pb2.InferRequest.FromString(_parseable(rng))
    head.head.request.CopyFrom(request)
    if rng.random() < 0.2:
        content = mutated_bytes(content, rng)
    messages = [head.SerializeToString(), *_pieces(content, rng)]
    match rng.randrange(8):
        case 0:
            rng.shuffle(messages)
        case 1:
            messages.insert(rng.randrange(len(messages) + 1), messages[0])
        case 2:
            del messages[rng.randrange(len(messages)) :]
        case 3:
            at = rng.randrange(len(messages))
            messages[at] = mutated_bytes(messages[at], rng)
        case 4:
            messages.insert(rng.randrange(len(messages) + 1), b"")
        case _:
            pass
    return messages


def _pieces(content: bytes, rng: random.Random) -> list[bytes]:
    size = rng.choice((1, 7, 30, 100, 1000, 10_000)) if len(content) < 1500 else 997
    parts = [content[at : at + size] for at in range(0, len(content), size)]
    return [policy_pb2.InferProgressiveRequest(piece=part).SerializeToString() for part in parts]


def _parseable(rng: random.Random) -> bytes:
    """A request with wrong fields, without payload most of the time."""
    request = policy_pb2.InferRequest.FromString(mutated_fields(rng))
    if rng.random() < 0.9:
        request.ClearField("payload")
    return request.SerializeToString()
