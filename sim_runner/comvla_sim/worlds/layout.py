"""Which fixtures stand where: the random part of the tabletop, a pure function of the seed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from comvla_sim.worlds.fixtures import FIXTURES, NARROW_FIXTURES, WIDE_FIXTURE

WINDOW_SHARE = 0.4
"""Share of layouts with the window. A window layout has one window task among the two episodes that
the demonstrations record of it, so two fifths give its two tasks about their fair share."""

_PLACES_M = (-0.30, 0.0, 0.30)
_WINDOW_PLACE_M = 0.20
_JITTER_X_M, _JITTER_Y_M, _WINDOW_JITTER_M = 0.035, 0.03, 0.03


@dataclass(frozen=True)
class Layout:
    """One arrangement of the table.

    Attributes:
        seed: the seed it was drawn from.
        positions: position (x, y, z) in metres of the body of every fixture that is present.
        joints: start value of every fixture's joint, present or not (m or rad).
        hand: start position (x, y, z) of the hand in metres.
        task_draw: number in [0, 1) that picks the task when none is asked for.
    """

    seed: int
    positions: dict[str, tuple[float, float, float]]
    joints: dict[str, float]
    hand: tuple[float, float, float]
    task_draw: float

    @property
    def fixtures(self) -> tuple[str, ...]:
        """The fixtures that are present, in the order of :data:`FIXTURES`."""
        return tuple(name for name in FIXTURES if name in self.positions)


def draw_layout(seed: int, needed: str | None = None) -> Layout:
    """The layout of a seed.

    Every random number is drawn in every case, so that asking for a fixture that is already there
    changes nothing, and asking for one that is not changes as little as possible.

    Args:
        seed: an integer in [0, 2**32).
        needed: a fixture that must be present; None takes what comes.
    """
    # RandomState, unlike Generator, promises the same stream for ever: a seed stays a layout.
    random = np.random.RandomState(seed)
    order = [NARROW_FIXTURES[i] for i in random.permutation(len(NARROW_FIXTURES))]
    replaced = int(random.randint(len(_PLACES_M)))
    has_window = bool(random.uniform() < WINDOW_SHARE)
    side = float(random.choice([-1, 1]))
    jitter = {name: random.uniform(-1, 1, size=2) for name in FIXTURES}
    joints = {name: float(random.uniform(*fixture.start)) for name, fixture in FIXTURES.items()}
    hand = (
        float(random.uniform(-0.12, 0.12)),
        float(random.uniform(0.45, 0.55)),
        float(random.uniform(0.18, 0.30)),
    )
    task_draw = float(random.uniform())

    if needed == WIDE_FIXTURE:
        has_window = True
    if has_window:
        other = order[0] if needed in (None, WIDE_FIXTURE) else str(needed)
        places = {WIDE_FIXTURE: side * _WINDOW_PLACE_M, other: -side * _PLACES_M[-1]}
    else:
        if needed == order[-1]:
            order[replaced], order[-1] = order[-1], order[replaced]
        places = dict(zip(order, _PLACES_M, strict=False))
    positions = {}
    for name, x in places.items():
        wide = name == WIDE_FIXTURE
        dx, dy = jitter[name]
        positions[name] = (
            float(x + dx * (_WINDOW_JITTER_M if wide else _JITTER_X_M)),
            float(FIXTURES[name].depth_m + dy * (_WINDOW_JITTER_M if wide else _JITTER_Y_M)),
            FIXTURES[name].height_m,
        )
    return Layout(seed, positions, joints, hand, task_draw)
