"""Options of the command line that say over which links an evaluation runs."""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable, Sequence
from typing import TypeVar

from comvla.number_arguments import number, whole
from comvla_client.sending import POLICIES
from comvla_sim.experiments.errors import EvaluationError
from comvla_sim.experiments.link_case import (
    BUDGETS,
    CHANNELS,
    ENFORCEMENTS,
    LinkCase,
    scaled_bandwidth_hz,
)

T = TypeVar("T")

# Left at None, an option is known not to have been given, and the default is LinkCase's.
_SWEPT = ("channel", "mean_snr_db", "csi_delay", "enforce", "sending", "budget")
_FIXED = ("useful_tokens", "bandwidth_hz", "efficiency", "doppler_hz", "rician_k", "los_doppler_hz")


def listed(convert: Callable[[str], T]) -> Callable[[str], tuple[T, ...]]:
    """An argument type: values separated by commas, each once, in their order."""

    def parse(text: str) -> tuple[T, ...]:
        try:
            return tuple(dict.fromkeys(convert(x.strip()) for x in text.split(",") if x.strip()))
        except ValueError:
            raise argparse.ArgumentTypeError(
                f"expected numbers separated by commas, got {text!r}"
            ) from None

    return parse


def add_link_options(parser: argparse.ArgumentParser) -> None:
    """Adds the options; without ``--channel`` the link is ideal."""
    group = parser.add_argument_group(
        "radio link",
        "Without --channel nothing is lost and nothing takes time. With it one action is one control "
        "period of 50 ms, and what the link does not carry in its period costs the robot. Options "
        "marked * take several values, a,b,...: every combination is run on the same tables and "
        "the same fading.",
    )
    default = LinkCase()

    def add(name: str, kind: Callable[[str], object], what: str, dest: str | None = None) -> None:
        dest = dest or name.replace("-", "_")
        group.add_argument(f"--{name}", type=kind, dest=f"link_{dest}", help=what)

    names, numbers = listed(str), listed(number())
    add("channel", names, f"* {', '.join(CHANNELS)}, or trace:FILE (ideal)")
    add("mean-snr-db", numbers, f"* mean of the linear SNR, dB ({default.mean_snr_db:g})")
    add("csi-delay", listed(whole()), "* age in periods of the SNR that the robot is told (0)")
    add(
        "enforce",
        names,
        f"* what happens beyond the capacity: {', '.join(ENFORCEMENTS)} ({default.enforce})",
    )
    add("sending", names, f"* policy of sending: {', '.join(POLICIES)} ({default.sending})")
    add(
        "link-budget",
        names,
        f"* what a payload is sized by: {' or '.join(BUDGETS)} bytes ({default.budget})",
        "budget",
    )
    add("useful-tokens", whole(), f"the floor of policies with one ({default.useful_tokens})")
    add("bandwidth-hz", number(), "W (20 MHz scaled to the width of the tokens: 0.88 MHz for mini)")
    add("efficiency", number(), f"η ({default.efficiency:g})")
    add("doppler-hz", number(), f"f_d of the fading ({default.doppler_hz:g})")
    add("rician-k", number(), f"κ of Rician fading, linear ({default.rician_k:g})")
    add("los-doppler-hz", number(), "Doppler shift of the line of sight (0)")


def links_of(args: argparse.Namespace, token_dim: int) -> tuple[LinkCase | None, ...]:
    """The links that the options ask for, in their order; (None,) is the ideal one alone.

    Args:
        args: parsed with :func:`add_link_options`.
        token_dim: D of the model, which scales the bandwidth.

    Raises:
        EvaluationError, LinkError: options that no link can have, or that need a ``--channel``.
    """
    given = {name: getattr(args, f"link_{name}") for name in (*_SWEPT, *_FIXED)}
    given = {name: value for name, value in given.items() if value is not None}
    if "channel" not in given:
        if given:
            option = next(iter(given)).replace("_", "-").replace("budget", "link-budget")
            raise EvaluationError(
                f"--{option} is about a radio link, and this evaluation has none: add --channel, "
                "for example --channel rician"
            )
        return (None,)
    default = LinkCase(bandwidth_hz=scaled_bandwidth_hz(token_dim))
    swept: list[Sequence[object]] = [given.get(n, (getattr(default, n),)) for n in _SWEPT]
    for name, values in zip(_SWEPT, swept, strict=True):
        if not values:
            raise EvaluationError(f"--{name.replace('_', '-')} is empty")
    fixed = {name: given.get(name, getattr(default, name)) for name in _FIXED}
    links = []
    for values in itertools.product(*swept):
        case = LinkCase(**dict(zip(_SWEPT, values, strict=True)), **fixed)  # type: ignore[arg-type]
        case.check()
        links.append(case)
    return tuple(links)
