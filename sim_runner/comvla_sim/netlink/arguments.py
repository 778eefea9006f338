"""Arguments that describe a link and its channel, and what they make."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path

from comvla.errors import LinkError
from comvla.number_arguments import SEED, number, whole
from comvla_client.budget import PAPER_LINK, LinkProfile
from comvla_sim.netlink.link import LinkSettings

CHANNELS = ("constant", "rayleigh", "rician", "trace")


def add_channel(parser: argparse.ArgumentParser) -> None:
    """The SNR of each control period."""
    group = parser.add_argument_group("channel", "SNR in dB, one value for each control period")
    group.add_argument("--channel", choices=CHANNELS, default="rician", help="(rician)")
    group.add_argument(
        "--snr-db", type=number(), default=10.0, metavar="DB", help="mean, or the constant (10)"
    )
    group.add_argument("--rician-k", type=number(), default=3.0, metavar="K", help="linear (3)")
    group.add_argument("--doppler-hz", type=number(), default=10.0, metavar="HZ", help="(10)")
    group.add_argument("--trace", type=Path, metavar="FILE", help="CSV, for --channel trace")
    group.add_argument("--seed", type=SEED, default=1, help="of the fading (1)")


def add_link(parser: argparse.ArgumentParser) -> None:
    """The radio and what lies behind it."""
    group = parser.add_argument_group("link", "capacity = eta W T log2(1 + SNR) in each period")
    group.add_argument(
        "--bandwidth-hz", type=number(), metavar="HZ", help="W (the scale's own, 20e6)"
    )
    group.add_argument(
        "--period-s", type=number(), default=PAPER_LINK.period_s, metavar="S", help="T (0.05)"
    )
    group.add_argument(
        "--efficiency", type=number(), default=PAPER_LINK.efficiency, metavar="ETA", help="(0.38)"
    )
    group.add_argument(
        "--delay-ms", type=number(), default=0.0, metavar="MS", help="propagation, one way (0)"
    )
    group.add_argument("--mtu", type=whole(), default=1500, metavar="BYTES", help="(1500)")
    group.add_argument(
        "--congestion-control", default="cubic", metavar="NAME", help="of both ends (cubic)"
    )
    group.add_argument(
        "--sysctl",
        action="append",
        default=[],
        type=_sysctl,
        metavar="NAME=VALUE",
        help="net.ipv4 setting of both ends, e.g. tcp_slow_start_after_idle=0; may be repeated",
    )


def channel_of(arguments: argparse.Namespace) -> Iterable[float]:
    """The channel that the arguments describe.

    Raises:
        LinkError: a value out of range, or a trace that cannot be read.
    """
    from comvla_sim.channel import ConstantChannel, RayleighChannel, RicianChannel, TraceChannel

    kind, period_s = arguments.channel, arguments.period_s
    if (arguments.trace is None) == (kind == "trace"):
        raise LinkError("--channel trace and --trace FILE go together: give both or neither")
    if kind == "constant":
        return ConstantChannel(arguments.snr_db)
    if kind == "trace":
        return TraceChannel(arguments.trace)
    fading = (arguments.snr_db, arguments.doppler_hz, period_s, arguments.seed)
    if kind == "rayleigh":
        return RayleighChannel(*fading)
    return RicianChannel(*fading, arguments.rician_k)


def link_of(arguments: argparse.Namespace) -> LinkSettings:
    """The link that the arguments describe.

    Raises:
        LinkError: a value out of range.
    """
    bandwidth_hz = arguments.bandwidth_hz or PAPER_LINK.bandwidth_hz
    return LinkSettings(
        profile=LinkProfile(bandwidth_hz, arguments.period_s, arguments.efficiency),
        delay_s=arguments.delay_ms / 1e3,
        mtu_bytes=arguments.mtu,
        congestion_control=arguments.congestion_control,
        sysctls=dict(arguments.sysctl),
    )


def as_list(arguments: argparse.Namespace) -> list[str]:
    """The arguments of :func:`add_channel` and :func:`add_link` as another process takes them."""
    parser = argparse.ArgumentParser()
    add_channel(parser)
    add_link(parser)
    words: list[str] = []
    for name, default in vars(parser.parse_args([])).items():
        value = getattr(arguments, name)
        option = "--" + name.replace("_", "-")
        if name == "sysctl":
            words += [f"{option}={setting}={to}" for setting, to in value]
        elif value != default:
            words.append(f"{option}={value}")
    return words


def _sysctl(text: str) -> tuple[str, str]:
    name, _, value = text.partition("=")
    name = name.removeprefix("net.ipv4.")
    if not value or not name.replace("_", "").isalnum():
        raise argparse.ArgumentTypeError(
            f"expected NAME=VALUE, e.g. tcp_slow_start_after_idle=0, got {text!r}"
        )
    return name, value
