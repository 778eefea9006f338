"""The lines of the figures: a way of selecting, and a way of using the link."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

from comvla_sim.experiments.errors import EvaluationError
from comvla_sim.experiments.link_case import LinkCase
from comvla_sim.experiments.plan import FULL, EpisodeSpec

USEFUL_TOKENS = 4
"""The floor of the figures' policies: the shipped policy still succeeds in 90 % with 4 tokens."""


@dataclass(frozen=True)
class Series:
    """One line.

    Attributes:
        label: in the legend.
        colour: of the line, the same in every figure; those of Okabe and Ito for the chief ones.
        method: name of a selector.
        enforce: what the link does with bytes beyond its capacity.
        sending: policy of sending.
        budget: what payloads are sized by; Eq. (4) leaves out what frames the values.
        ideal: over no link at all, a level that the line is compared with.
    """

    label: str
    colour: str
    method: str = "hard_voting"
    enforce: str = "prefix"
    sending: str = "paper"
    budget: str = "framed"
    ideal: bool = False

    def link(self, link: LinkCase) -> LinkCase | None:
        """This way of using a link."""
        if self.ideal:
            return None
        case = replace(link, enforce=self.enforce, sending=self.sending, budget=self.budget)
        return replace(case, useful_tokens=USEFUL_TOKENS) if "floor" in self.sending else case

    def spec(self, link: LinkCase, task: str, episode: int, num_tokens: int) -> EpisodeSpec:
        """One episode of this line."""
        k = num_tokens if self.method == FULL else None
        return EpisodeSpec("normal", self.method, k, task, episode, self.link(link))


SERIES: Mapping[str, Series] = MappingProxyType(
    {
        "full": Series("all tokens, no limit", "#222222", FULL, ideal=True),
        "unenforced": Series(
            "not enforced, as in the paper", "#D55E00", enforce="none", budget="paper"
        ),
        "random": Series(
            "random tokens, not enforced", "#999999", "random", enforce="none", budget="paper"
        ),
        "drop": Series("enforced: too large is lost", "#0072B2", enforce="drop"),
        "queue": Series("enforced: too large comes late", "#56B4E9", enforce="queue"),
        "prefix": Series("enforced: what fits is used", "#E69F00"),
        "margin": Series(
            "enforced: margin, too large is lost", "#CC79A7", enforce="drop", sending="margin"
        ),
        "progressive": Series("enforced: progressive", "#8C6D31", sending="progressive"),
        "floor": Series(
            "enforced: floor, too large is lost", "#7F3C8D", enforce="drop", sending="floor"
        ),
        "progressive+floor": Series(
            "enforced: progressive with a floor", "#009E73", sending="progressive+floor"
        ),
        "random-drop": Series(
            "random tokens, enforced: too large is lost", "#5A5A8A", "random", "drop"
        ),
        "full-queue": Series("all tokens, enforced: comes late", "#7A1F1F", FULL, "queue"),
    }
)
"""Every line that can be drawn, by the name that ``--series`` takes."""


def chosen(names: tuple[str, ...]) -> dict[str, Series]:
    """Lines by name.

    Raises:
        EvaluationError: none, or an unknown one.
    """
    if not names:
        raise EvaluationError(f"--series is empty: choose among {', '.join(SERIES)}")
    for name in names:
        if name not in SERIES:
            raise EvaluationError(f"--series {name!r} is unknown: choose among {', '.join(SERIES)}")
    return {name: SERIES[name] for name in names}
