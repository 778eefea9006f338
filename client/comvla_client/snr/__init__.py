"""Where the signal-to-noise ratio of the link comes from.

| source | knows the SNR from |
|---|---|
| a number, :class:`ConstantSnr` | being told |
| a function, :class:`CallableSnr` | a program of yours |
| :class:`TraceSnr` | a recording, played in real time |
| :class:`WifiSnr` | the Wi-Fi driver: signal less noise |
| :class:`ModemManagerSnr` | the LTE or 5G modem |
| :class:`GoodputSnr` | the bytes that were acknowledged |
| :class:`FusedSnr` | one of the above and goodput, each weighed by its age and error |

No ``read()`` waits for anything. A source belongs to whoever made it: a client asks it and tells it
how steps end, and does not close it, since two robots may share one radio.
"""

from comvla_client.snr.evidence import Evidence, equivalent_snr_db, evidence_of
from comvla_client.snr.fused import FusedSnr
from comvla_client.snr.goodput import GoodputSnr
from comvla_client.snr.modem import ModemManagerSnr
from comvla_client.snr.source import (
    CallableSnr,
    ConstantSnr,
    SnrInput,
    SnrReading,
    SnrSource,
    as_reading,
    as_source,
)
from comvla_client.snr.trace import Trace, TraceSnr, read_trace
from comvla_client.snr.wifi import WifiSnr

__all__ = [
    "CallableSnr",
    "ConstantSnr",
    "Evidence",
    "FusedSnr",
    "GoodputSnr",
    "ModemManagerSnr",
    "SnrInput",
    "SnrReading",
    "SnrSource",
    "Trace",
    "TraceSnr",
    "WifiSnr",
    "as_reading",
    "as_source",
    "equivalent_snr_db",
    "evidence_of",
    "read_trace",
]
