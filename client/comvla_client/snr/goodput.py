"""The SNR from nothing but what the link was seen to carry."""

from __future__ import annotations

import time
from collections.abc import Callable

from comvla_client.budget import PAPER_LINK, LinkProfile
from comvla_client.snr.filter import RAYLEIGH_STD_DB
from comvla_client.snr.fused import FusedSnr
from comvla_client.snr.source import SnrReading


class GoodputSnr(FusedSnr):
    """An equivalent SNR from acknowledged bytes: works over any interface, and needs no modem.

    It says what Eq. (1) needs to hear for the budget to be what the link really carried. Before the
    first answer it is ``initial_db``, and back towards it drifts a link that was silent for long, so
    that a robot that stopped sending tries again.

    Args:
        link: the profile whose Eq. (1) turns rates into SNR; use the client's own.
        initial_db: a first guess in dB.
        initial_std_db: how far off it may be, in dB.
        coherence_s, fading_std_db, goodput_std_db, drift_db, round_trip_s, clock: as for
            :class:`~comvla_client.snr.fused.FusedSnr`.

    Raises:
        LinkError: a parameter out of range.
    """

    def __init__(
        self,
        link: LinkProfile = PAPER_LINK,
        *,
        initial_db: float = 10.0,
        initial_std_db: float = 10.0,
        coherence_s: float = 0.02,
        fading_std_db: float = RAYLEIGH_STD_DB,
        goodput_std_db: float = 2.0,
        drift_db: float = 2.0,
        round_trip_s: float = 0.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__(
            initial_db,
            link,
            coherence_s=coherence_s,
            fading_std_db=fading_std_db,
            reported_std_db=initial_std_db,
            goodput_std_db=goodput_std_db,
            drift_db=drift_db,
            round_trip_s=round_trip_s,
            clock=clock,
        )
        self._evidence_s = clock()

    def _age_s(self, reported: SnrReading, now_s: float) -> float:
        # A guess has no age; what counts is when the link was last seen.
        assert self._evidence_s is not None
        return max(0.0, now_s - self._evidence_s)
