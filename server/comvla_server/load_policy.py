"""What a server does when more is asked of it than it can answer in time."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from comvla_server.settings import ServerSettings


@dataclass(frozen=True, kw_only=True)
class LoadPolicy:
    """Settings of a :class:`comvla_server.batcher.Batcher`; the names are those of the server's settings.

    Attributes:
        admission: turn away at the door what cannot be answered by its deadline.
        fair_shares: while more is asked than can be answered, turn away robots that lately got more
            than the others before those that got less.
        earliest_deadline_first: whose deadline comes first is computed first; else in order of arrival.
        deadline_margin_s: how long before its deadline an answer has to be ready, so that it arrives.
        advise_tokens: tell robots how many tokens the server can take from each.
        advise_least_tokens: never advise fewer than this.
        advise_target_load: share of its capacity that the server wants to be asked for.
    """

    admission: bool = True
    fair_shares: bool = True
    earliest_deadline_first: bool = True
    deadline_margin_s: float = 0.005
    advise_tokens: bool = True
    advise_least_tokens: int = 20
    advise_target_load: float = 0.8

    @classmethod
    def of(cls, settings: ServerSettings) -> LoadPolicy:
        """As a server's settings say."""
        return cls(**{field.name: getattr(settings, field.name) for field in fields(cls)})
