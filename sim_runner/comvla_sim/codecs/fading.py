"""Gains of independent control periods, for training and for curves over the SNR.

In an episode, periods follow one another and their gains come from :mod:`comvla_sim.channel`. A
batch of pictures has nothing to do with time: each is a period of its own.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from comvla_sim.training.run_state import TrainingError

RICIAN_K = {"awgn": float("inf"), "rician": 3.0, "rayleigh": 0.0}
"""Kinds of channel, by the Rician K-factor κ: the paper's 3, and its two limits."""


def draw_gains(kind: str, count: int, rng: np.random.Generator) -> npt.NDArray[np.complex64]:
    """(count,) complex gains with E|h|² = 1.

    h = √(κ/(κ+1)) exp(jφ) + √(1/(κ+1)) g, with φ uniform and g complex Gaussian. For ``"awgn"``
    the gain is 1.

    Raises:
        TrainingError: an unknown kind.
    """
    if kind not in RICIAN_K:
        raise TrainingError(f"unknown channel {kind!r}: choose among {', '.join(RICIAN_K)}")
    if kind == "awgn":
        return np.ones(count, np.complex64)
    k = RICIAN_K[kind]
    phase = np.exp(2j * np.pi * rng.uniform(size=count))
    scattered = rng.standard_normal((count, 2)) @ np.array([1, 1j]) / np.sqrt(2)
    gains = np.sqrt(k / (k + 1)) * phase + np.sqrt(1 / (k + 1)) * scattered
    return np.asarray(gains, np.complex64)
