"""What the end of a step tells about the link: the equivalent SNR of its goodput."""

from __future__ import annotations

from dataclasses import dataclass

from comvla.errors import LinkError
from comvla_client.budget import LinkProfile
from comvla_client.report import StepReport

SHORTEST_TRANSFER_S = 1e-4
"""Transfers are never taken to be shorter: below this, clocks and scheduling are all one sees."""


@dataclass(frozen=True)
class Evidence:
    """One observation of the link.

    Attributes:
        snr_db: SNR in dB at which Eq. (1) gives the observed rate.
        bound: whether the link only is known to have been slower than that.
    """

    snr_db: float
    bound: bool = False


def equivalent_snr_db(delivered_bytes: float, elapsed_s: float, link: LinkProfile) -> float:
    """The SNR in dB at which a link carries so many bytes in so many seconds: Eq. (1) inverted.

    Efficiency is part of the profile, so a budget computed from the result is what the link was seen
    to carry, whatever the true SNR may be.

    Raises:
        LinkError: no bytes, or no time.
    """
    if not (delivered_bytes > 0 and elapsed_s > 0):
        raise LinkError(
            f"expected bytes and seconds > 0, got {delivered_bytes!r} bytes in {elapsed_s!r} s: "
            "tell only transfers that took place"
        )
    elapsed_s = max(elapsed_s, SHORTEST_TRANSFER_S)
    return link.snr_db(8.0 * delivered_bytes / elapsed_s * link.period_s)


def evidence_of(
    report: StepReport, link: LinkProfile, round_trip_s: float = 0.0
) -> Evidence | None:
    """What a step tells about the uplink.

    * All tokens arrived: the framed bytes crossed in the time of the call, less the server's own
      share and an empty round trip.
    * Some arrived: the link carried those in the window that they had, and no more.
    * No answer in time: the link was slower than the bytes that were sent over the time of waiting,
      which is that window at least; in a simulated link it passes at once. (Or the server was slow: a
      single failure is therefore taken with reserve.)

    Args:
        report: of the step.
        link: the profile that sized it.
        round_trip_s: what a call without payload takes, in seconds.

    Returns:
        None where the step says nothing about the link: nothing was sent, or the server refused.
    """
    window_s = report.window_s or link.window_s
    waited_s = report.timings_s.get("call", 0.0) - round_trip_s
    if report.framed_bytes <= 0 or report.timings_s.get("call", 0.0) <= 0.0:
        return None
    if report.source != "cloud":
        if report.fallback_reason != "deadline":
            return None
        waited_s = max(waited_s, window_s)
        return Evidence(equivalent_snr_db(report.framed_bytes, waited_s, link), bound=True)
    if 0 < report.tokens_used < report.tokens:
        lost_bytes = report.encoded_bytes * (1.0 - report.tokens_used / report.tokens)
        arrived_bytes = report.framed_bytes - lost_bytes
        return Evidence(equivalent_snr_db(arrived_bytes, window_s, link))
    under_way_s = waited_s - report.server_timings_s.get("total", 0.0)
    # Never less than a tenth of the call: a round trip that was given too long must not make the
    # link look infinitely fast.
    floor_s = max(0.1 * report.timings_s["call"], SHORTEST_TRANSFER_S)
    return Evidence(equivalent_snr_db(report.framed_bytes, max(under_way_s, floor_s), link))
