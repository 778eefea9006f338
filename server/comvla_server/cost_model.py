"""How long a forward pass takes, learned from those that ran."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from operator import mul
from statistics import median

import numpy as np
from numpy.typing import NDArray

_Array = NDArray[np.float64]

# Passes that are remembered, and after how many new ones the fit is made anew.
_WINDOW = 96
_REFIT_EVERY = 8
# Passes whose median says whether the machine has become faster or slower since the fit.
_RECENT = 7
# How much the last fit weighs where passes of the window do not tell its terms apart, in passes.
_PRIOR_WEIGHT = 0.3
# Residuals beyond so many typical ones count less (Huber, 1964).
_HUBER = 1.5
_SPREAD_QUANTILE = 0.95


@dataclass(frozen=True)
class Work:
    """What one forward pass has to do.

    Attributes:
        requests: how many share it.
        tokens: visual tokens of all of them.
        pictures: how many of them bring pictures, which the vision half looks at first.
    """

    requests: int
    tokens: int
    pictures: int = 0

    @classmethod
    def of(cls, parts: Iterable[Work]) -> Work:
        """All of these in one pass."""
        requests = tokens = pictures = 0
        for part in parts:
            requests += part.requests
            tokens += part.tokens
            pictures += part.pictures
        return cls(requests, tokens, pictures)


class CostModel:
    """Seconds of a pass: a fixed part, and a part for each request, token and picture, none negative.

    The parts are fitted to the latest passes by least squares in which outliers count little, so
    that a pause of the machine passes by. Passes that are all alike cannot tell the parts apart;
    what they leave open stays as it was fitted last. A machine that becomes slower or faster is
    noticed within four passes, long before the window is renewed.

    Attributes:
        fixed_s: seconds of any pass.
        request_s: seconds of each request in it.
        token_s: seconds of each visual token.
        picture_s: seconds of each request with pictures.
        spread_s: 95th percentile of how far the latest passes were from what was predicted, seconds.
    """

    def __init__(self) -> None:
        self._works: deque[tuple[float, float, float, float]] = deque(maxlen=_WINDOW)
        self._seconds: deque[float] = deque(maxlen=_WINDOW)
        self._fitted_s: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
        self._level = 1.0
        self._since_fit = 0
        self.fixed_s = self.request_s = self.token_s = self.picture_s = 0.0
        self.spread_s = 0.0

    @property
    def known(self) -> bool:
        """Whether any pass was seen; before that everything is predicted to take no time."""
        return bool(self._seconds)

    def observe(self, work: Work, seconds: float) -> None:
        """Learns from a pass that succeeded."""
        if work.requests < 1 or not seconds > 0.0:
            return
        self._works.append((1.0, work.requests, work.tokens, work.pictures))
        self._seconds.append(seconds)
        self._since_fit += 1
        if self._since_fit >= _REFIT_EVERY or len(self._seconds) <= _REFIT_EVERY:
            self._fit()
            self._since_fit = 0
        self._follow()

    def predict(self, work: Work) -> float:
        """Seconds that a pass will take; 0 before the first was seen."""
        return (
            self.fixed_s
            + self.request_s * work.requests
            + self.token_s * work.tokens
            + self.picture_s * work.pictures
        )

    def request_cost_s(self, max_batch: int, tokens: float, pictures: float = 0.0) -> float:
        """Seconds of the model that one request costs where batches are full.

        Args:
            max_batch: requests in a full batch.
            tokens: visual tokens of a request.
            pictures: share of requests that bring pictures.
        """
        shared_s = self.fixed_s / max_batch
        return shared_s + self.request_s + self.token_s * tokens + self.picture_s * pictures

    def _fit(self) -> None:
        works, seconds = np.array(self._works), np.array(self._seconds)
        scales = np.maximum(works.mean(axis=0), 1e-9)
        typical_s = float(np.median(seconds))
        # Dimensionless: each part as a share of a typical pass, at the window's mean work.
        rows, targets = works / scales, seconds / typical_s
        prior = np.array(self._fitted_s) * self._level * scales / typical_s
        prior_rows = np.sqrt(_PRIOR_WEIGHT) * np.eye(4)
        weights = np.ones(len(targets))
        shares = prior
        for _ in range(4):
            root = np.sqrt(weights)[:, None]
            shares = _least_squares(
                np.vstack([root * rows, prior_rows]),
                np.concatenate([root[:, 0] * targets, np.sqrt(_PRIOR_WEIGHT) * prior]),
            )
            residuals = np.abs(targets - rows @ shares)
            limit = _HUBER * max(float(np.median(residuals)) / 0.6745, 1e-3)
            weights = np.minimum(1.0, limit / np.maximum(residuals, 1e-12))
        self._fitted_s = tuple(map(float, shares * typical_s / scales))
        misses_s = np.abs(targets - rows @ shares) * typical_s
        self.spread_s = float(np.quantile(misses_s, _SPREAD_QUANTILE))

    def _follow(self) -> None:
        """Scales the fit by how the latest passes compare with it; plain numbers, since it runs after each."""
        ratios = []
        for i in range(-min(_RECENT, len(self._seconds)), 0):
            fitted_s = sum(map(mul, self._works[i], self._fitted_s))
            if fitted_s > 0.0:
                ratios.append(self._seconds[i] / fitted_s)
        self._level = median(ratios) if ratios else 1.0
        parts = [self._level * part_s for part_s in self._fitted_s]
        self.fixed_s, self.request_s, self.token_s, self.picture_s = parts


def _least_squares(rows: _Array, targets: _Array) -> _Array:
    """The solution without negative entries: whatever would be negative is left out in turn."""
    solution = np.zeros(rows.shape[1])
    left = list(range(rows.shape[1]))
    while left:
        found, *_ = np.linalg.lstsq(rows[:, left], targets, rcond=None)
        worst = int(np.argmin(found))
        if found[worst] >= 0.0:
            solution[left] = found
            break
        del left[worst]
    return solution
