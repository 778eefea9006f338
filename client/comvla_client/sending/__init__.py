"""How much of an observation is sent when, over a link that does not promise anything.

* :class:`Paper`: as much as the reported SNR says;
* :class:`Margin`: as much as very likely fits, given the report's age;
* :class:`Progressive`: most important tokens first, cut when the window ends;
* :class:`Floor`: one of the others, and nothing where it would be too little to be useful.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from comvla_client.fading import Fading
from comvla_client.sending.floor import USEFUL_TOKENS, Floor
from comvla_client.sending.margin import Margin
from comvla_client.sending.paper import Paper
from comvla_client.sending.plan import Outcome, Plan, SendingPolicy, Situation
from comvla_client.sending.progressive import Progressive

__all__ = [
    "POLICIES",
    "USEFUL_TOKENS",
    "Fading",
    "Floor",
    "Margin",
    "Outcome",
    "Paper",
    "Plan",
    "Progressive",
    "SendingPolicy",
    "Situation",
    "make_policy",
]

POLICIES: Mapping[str, Callable[[], SendingPolicy]] = {
    "paper": Paper,
    "margin": Margin,
    "progressive": Progressive,
    "floor": Floor,
    "margin+floor": lambda: Floor(Margin()),
    "progressive+floor": lambda: Floor(Progressive()),
}
"""Policies by name, each with its defaults. An object of your own, or of another make-up, does too."""


def make_policy(sending: str | SendingPolicy) -> SendingPolicy:
    """A policy by its name, or the object itself.

    Raises:
        ValueError: no policy has that name.
    """
    if not isinstance(sending, str):
        return sending
    if sending not in POLICIES:
        raise ValueError(
            f"expected sending among {', '.join(POLICIES)}, or an object with plan(), got "
            f"{sending!r}"
        )
    return POLICIES[sending]()
