"""The SNR of a radio link, one value for each control period.

Every channel here is an iterable without end: ``for snr_db in channel`` always starts at period 0,
and the same seed gives the same values everywhere.
"""

from comvla_sim.channel.base import Channel, ConstantChannel, DelayedChannel, delayed
from comvla_sim.channel.fading import BLOCK_PERIODS, RayleighChannel, RicianChannel, bessel_j0
from comvla_sim.channel.outages import GilbertElliottChannel, WifiChannel
from comvla_sim.channel.trace import TraceChannel

__all__ = [
    "BLOCK_PERIODS",
    "Channel",
    "ConstantChannel",
    "DelayedChannel",
    "GilbertElliottChannel",
    "RayleighChannel",
    "RicianChannel",
    "TraceChannel",
    "WifiChannel",
    "bessel_j0",
    "delayed",
]
