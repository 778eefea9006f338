"""The radio link that an episode runs over, as far as one has to know it to run it again."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from comvla.errors import LinkError
from comvla_client import LinkProfile
from comvla_client.sending import (
    POLICIES,
    USEFUL_TOKENS,
    Floor,
    Margin,
    Paper,
    Progressive,
    SendingPolicy,
)
from comvla_sim.channel import (
    Channel,
    ConstantChannel,
    GilbertElliottChannel,
    RayleighChannel,
    RicianChannel,
    TraceChannel,
    WifiChannel,
)
from comvla_sim.experiments.errors import EvaluationError
from comvla_sim.link import MODES, UNENFORCED

CHANNELS = ("rayleigh", "rician", "constant", "gilbert-elliott", "wifi")
TRACE = "trace:"
"""``trace:FILE`` is a recorded link (:class:`comvla_sim.channel.TraceChannel`)."""

ENFORCEMENTS = (UNENFORCED, *MODES)
"""What the link does with bytes beyond its capacity (:class:`comvla_sim.link.EnforcedLink`)."""

BUDGETS = ("paper", "framed")

LEAD_IN = 256
"""Periods that pass before the robot moves: it has been on the air for some seconds and has heard
reports, so that one that is d periods old exists from the start. The robot meets the same fading
whatever d is."""

MOST_DELAY = 100

GOOD_S, BAD_S = 2.0, 0.3
"""Mean dwell times of the Gilbert-Elliott channel of evaluations, in seconds."""

PAPER_BANDWIDTH_HZ, PAPER_TOKEN_DIM = 20e6, 2176


@dataclass(frozen=True)
class LinkCase:
    """One link and one way of using it.

    Attributes:
        channel: a name of :data:`CHANNELS`, or ``trace:FILE``.
        mean_snr_db: in dB; the good state's for Gilbert-Elliott; nothing for a trace.
        csi_delay: d, age in control periods of the SNR that the robot is told.
        enforce: a name of :data:`ENFORCEMENTS`.
        sending: how the robot sizes and sends its payloads.
        budget: ``"paper"`` counts values alone (Eq. (4)), ``"framed"`` all bytes on the wire.
        useful_tokens: the useful minimum of policies with a floor.
        bandwidth_hz: W.
        period_s: T, seconds; one action takes one period.
        efficiency: η.
        doppler_hz: f_d of the fading, Hz.
        rician_k: κ of Rician fading, linear.
        los_doppler_hz: Doppler shift of the line of sight, Hz.
        trace_sha256: of the trace's file; empty otherwise.
    """

    channel: str = "rician"
    mean_snr_db: float = 10.0
    csi_delay: int = 0
    enforce: str = "prefix"
    sending: str = "paper"
    budget: str = "framed"
    useful_tokens: int = USEFUL_TOKENS
    bandwidth_hz: float = 0.88e6
    period_s: float = 0.05
    efficiency: float = 0.38
    doppler_hz: float = 10.0
    rician_k: float = 3.0
    los_doppler_hz: float = 0.0
    trace_sha256: str = ""

    def __post_init__(self) -> None:
        _known("--enforce", self.enforce, ENFORCEMENTS)
        _known("--link-budget", self.budget, BUDGETS)
        _known("--sending", self.sending, tuple(POLICIES))
        if not self.channel.startswith(TRACE):
            _known("--channel", self.channel, (*CHANNELS, f"{TRACE}FILE"))
        if not 0 <= self.csi_delay <= MOST_DELAY:
            raise EvaluationError(
                f"--csi-delay must be from 0 to {MOST_DELAY} control periods, got {self.csi_delay}"
            )
        if self.useful_tokens < 1:
            raise EvaluationError(f"--useful-tokens must be at least 1, got {self.useful_tokens}")
        if self.channel.startswith(TRACE) and not self.trace_sha256:
            object.__setattr__(self, "trace_sha256", _digest(self.trace_path))

    def check(self) -> None:
        """Refuses numbers that no link can have.

        Raises:
            LinkError: names the number and what it must be.
        """
        self.profile()
        self.make_channel(0)

    @property
    def trace_path(self) -> Path:
        """The trace's file."""
        return Path(self.channel.removeprefix(TRACE))

    def profile(self) -> LinkProfile:
        """Bandwidth, period and efficiency.

        Raises:
            LinkError: out of range.
        """
        return LinkProfile(self.bandwidth_hz, self.period_s, self.efficiency)

    def make_channel(self, seed: int) -> Channel:
        """The channel of one episode.

        Args:
            seed: of the fading; for a trace, the period to begin with, counted around its end.

        Raises:
            LinkError: a number that no channel can have, or a trace that is none.
        """
        mean, period_s = self.mean_snr_db, self.period_s
        if self.channel == "rayleigh":
            return RayleighChannel(mean, self.doppler_hz, period_s, seed)
        if self.channel == "rician":
            return RicianChannel(
                mean, self.doppler_hz, period_s, seed, self.rician_k, self.los_doppler_hz
            )
        if self.channel == "constant":
            return ConstantChannel(mean)
        if self.channel == "gilbert-elliott":
            return GilbertElliottChannel(mean, float("-inf"), GOOD_S, BAD_S, period_s, seed)
        if self.channel == "wifi":
            return WifiChannel(
                mean, period_s, seed, doppler_hz=self.doppler_hz, rician_k=self.rician_k
            )
        if self.trace_sha256 != _digest(self.trace_path):
            raise EvaluationError(
                f"{self.trace_path} has changed since it was measured with: give the changed trace "
                "another name"
            )
        return TraceChannel(self.trace_path, period_s=period_s, start=seed)

    def make_sending(self, clock: Callable[[], float]) -> SendingPolicy:
        """A fresh policy of sending.

        Args:
            clock: seconds of simulated time.
        """
        made: dict[str, Callable[[], SendingPolicy]] = {
            "paper": Paper,
            "margin": lambda: Margin(clock=clock),
            "progressive": lambda: Progressive(clock=clock),
        }
        name = "paper+floor" if self.sending == "floor" else self.sending
        inner, _, floor = name.partition("+")
        policy = made[inner]()
        return Floor(policy, self.useful_tokens) if floor else policy

    @property
    def label(self) -> str:
        """The link in a few words, enough to tell it from others of one evaluation."""
        where = (
            self.channel
            if self.channel.startswith(TRACE)
            else (f"{self.channel} {self.mean_snr_db:g} dB")
        )
        sized = "" if self.budget == "framed" else f" ({self.budget})"
        return f"{where}, d={self.csi_delay}, {self.enforce}, {self.sending}{sized}"

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON values."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> LinkCase:
        """What :meth:`to_dict` gave; what an older version did not write has its default.

        Raises:
            TypeError: something that no link has.
        """
        return cls(**values)


def scaled_bandwidth_hz(token_dim: int) -> float:
    """The paper's 20 MHz scaled to tokens of another width, so that budgets are alike.

    Args:
        token_dim: D.

    Returns:
        Hertz, to two digits: 0.88 MHz for comvla-mini's 96.
    """
    return float(f"{PAPER_BANDWIDTH_HZ * token_dim / PAPER_TOKEN_DIM:.2g}")


def channel_seed(layout_seed: int, task_index: int) -> int:
    """The seed of an episode's fading: it follows table and task, so all methods meet the same.

    Args:
        layout_seed: of the episode's layout.
        task_index: of its task among the world's.
    """
    return int(np.random.SeedSequence([layout_seed, task_index]).generate_state(1)[0])


def _known(option: str, name: str, known: tuple[str, ...]) -> None:
    if name not in known:
        raise EvaluationError(f"{option} {name!r} is unknown: choose among {', '.join(known)}")


def _digest(path: Path) -> str:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise LinkError(f"cannot read the SNR trace {path}: {error}") from error
