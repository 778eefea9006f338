"""What coded pictures of this world take at the paper's picture size, where this policy sees smaller ones."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from comvla.images.stills import STILL_CODINGS, encode_still
from comvla_sim.experiments.layouts import evaluation_layout
from comvla_sim.experiments.worker import Worker
from comvla_sim.paper.results import Json
from comvla_sim.worlds.rendering import Renderer

SIDE = 224
"""Pixels of a view in OpenVLA-OFT."""

LAYOUTS = 8
REFERENCE = "jpeg-95"
"""A quality that nobody calls lossy to the eye; always measured."""


def measure_picture_bytes(worker: Worker, seed: int, methods: Sequence[str]) -> Json:
    """Mean KiB of both views, one picture of each of some tables.

    Args:
        worker: its world has to draw here.
        seed: of the evaluation.
        methods: names of codings with their quality; those of video and learned codecs are left out.

    Returns:
        ``side``, ``pictures``, and ``kib`` by name.
    """
    world = worker.world
    shots = []
    for episode in range(LAYOUTS):
        world.reset(seed=evaluation_layout(seed, episode))
        renderer = Renderer(world.model, SIDE)
        try:
            shots.append(np.array(renderer.draw(world.data)))
        finally:
            renderer.close()
    kib = {}
    for name in dict.fromkeys((*methods, REFERENCE)):
        coding, _, quality = name.partition("-")
        if coding in STILL_CODINGS and quality:
            sizes = [
                len(encode_still(coding, view, int(quality))) for shot in shots for view in shot
            ]
            kib[name] = round(math.fsum(sizes) / len(shots) / 1024, 2)
    return {"side": SIDE, "pictures": len(shots), "kib": kib}
