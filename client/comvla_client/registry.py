"""Everything that can go up the link, by name: one table for the client, ``--help``, evaluations and reports.

A selector of your own is found by ``"package.module:ClassName"`` everywhere a name is. Under a name of its own it
is found once :func:`register` was called, or where an installed package declares it as an entry point of the group
``comvla.selectors``.
"""

from __future__ import annotations

import functools
import importlib
import inspect
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from comvla.errors import ComVLAError
from comvla_client.image_forms import IMAGE_FORMS as IMAGE_FORMS  # a part of this table
from comvla_client.image_forms import make_image_form, split_name
from comvla_client.pruners import VLAADP, LightVLA, MotionGate
from comvla_client.selection import (
    FullTransmission,
    HardVoting,
    HardVotingRandomTies,
    RandomSelection,
    Selector,
    SoftVoting,
    TokenNorm,
)
from comvla_client.token_uplink import TokenUplink
from comvla_client.uplink import UplinkForm
from comvla_client.voting import DiverseVoting, MultiVoting, ViewQuotas

if TYPE_CHECKING:
    from typing_extensions import TypeIs

ENTRY_POINTS = "comvla.selectors"
"""Entry-point group in which an installed package may offer selectors."""

_Made = TypeVar("_Made", covariant=True)


class UnknownMethodError(ComVLAError, ValueError):
    """No selector or picture coding of that name; the message lists those that exist."""


@dataclass(frozen=True)
class Entry(Generic[_Made]):
    """One row of the table.

    Attributes:
        make: gives a new one: a class, or a function without arguments.
        summary: one line, for ``--help`` and tables.
        equation: how it decides.
        source: where that comes from.
    """

    make: Callable[..., _Made]
    summary: str
    equation: str
    source: str


SELECTORS: dict[str, Entry[Selector]] = {
    "hard_voting": Entry(
        HardVoting,
        "each word votes for one token; ties by attention",
        "I_j = Σ_i 1[j = argmax_k h_iᵀ v_k], h_i = Σ_j α_ij v_j",
        "ComVLA, Eq. (3)",
    ),
    "soft_voting": Entry(
        SoftVoting, "attention of all words, summed", "I_j = Σ_i α_ij", "ComVLA, Table III"
    ),
    "random": Entry(
        RandomSelection, "tokens drawn by lot", "a random permutation", "ComVLA, Random Prune"
    ),
    "full": Entry(
        FullTransmission,
        "all N tokens, whatever the link carries",
        "K = N",
        "OpenVLA-OFT, not pruned",
    ),
    "token_norm": Entry(
        TokenNorm,
        "largest tokens first, without language",
        "I_j = ‖v_j‖₂",
        "control of this project",
    ),
    "hard_voting_random_ties": Entry(
        HardVotingRandomTies,
        "hard voting, ties drawn by lot: what votes alone are worth",
        "as hard_voting",
        "control of this project",
    ),
    "multi_voting": Entry(
        MultiVoting,
        "each word votes for its 3 best tokens",
        "I_j = Σ_i 1[j ∈ top_m(h_iᵀ v)], m = 3",
        "this project",
    ),
    "diverse_voting": Entry(
        DiverseVoting,
        "multi_voting, then what is unlike the tokens before it",
        "argmax_j λ r_j − (1 − λ) max_{s sent} cos(z_j, z_s), λ = 0.7",
        "this project; MMR of Carbonell and Goldstein, 1998",
    ),
    "view_quotas": Entry(
        ViewQuotas,
        "hard voting within each camera, cameras take turns",
        "of the first K, view v holds K s_v; s_v = 1 / views",
        "this project",
    ),
    "lightvla": Entry(
        LightVLA,
        "every token that some token votes for; decides K itself",
        "∪_i argmax_j s_ij, s = rms(softmax(P Tᵀ / √d) T) Pᵀ / √d",
        "LightVLA (LiAutoAD/LightVLA)",
    ),
    "vla_adp": Entry(
        lambda: VLAADP(gate=MotionGate()),
        "best 75 % by the first layer's text scores, while the arm moves far",
        "s_j = mean over words and heads of q · k_j / √d_h; 40 % main, 60 % wrist view",
        "VLA-ADP (chen7086/VLA-ADP)",
    ),
}
"""Selectors of tokens, by name."""


def register(name: str, entry: Entry[Selector]) -> None:
    """Gives a selector a name in this process.

    Raises:
        ValueError: the name is taken.
    """
    if name in SELECTORS or name in IMAGE_FORMS:
        raise ValueError(f"the name {name!r} is taken: choose another")
    SELECTORS[name] = entry


def selectors() -> Mapping[str, Entry[Selector]]:
    """:data:`SELECTORS`, and what installed packages offer."""
    found = dict(SELECTORS)
    for point in entry_points(group=ENTRY_POINTS):
        if point.name not in found:
            found[point.name] = Entry(
                _offered(point.value), f"offered by {point.value}", "", point.value
            )
    return found


def names() -> tuple[str, ...]:
    """All that can be asked for, for messages: selectors, then picture codings with their number."""
    images = (
        f"{name}[-{entry.number}]" if entry.number else name for name, entry in IMAGE_FORMS.items()
    )
    return (*selectors(), *images)


def find_entry(name: str) -> Entry[Selector] | Entry[UplinkForm]:
    """The row of a name: a selector, a picture coding, or ``package.module:ClassName``.

    Raises:
        UnknownMethodError: there is none.
    """
    known = selectors()
    if name in known:
        return known[name]
    parts = split_name(name)
    if parts is not None:
        form, number = parts
        return Entry(lambda: make_image_form(form, number, name), form.summary, "", form.source)
    if ":" in name:
        made = _imported(name)
        return Entry(made, (inspect.getdoc(made) or name).splitlines()[0], "", name)
    raise UnknownMethodError(
        f"expected one of {', '.join(names())}, or package.module:ClassName of your own, got {name!r}"
    )


def make_selector(selector: str | Selector) -> Selector:
    """A selector by name, or the given one unchanged.

    Raises:
        UnknownMethodError: no selector of that name.
    """
    if not isinstance(selector, str):
        return selector
    made = find_entry(selector).make()
    if not selects(made):
        raise UnknownMethodError(
            f"{selector!r} selects no tokens: pass it as uplink=, or as selector= one of "
            f"{', '.join(selectors())}"
        )
    return made


def make_uplink(
    uplink: str | UplinkForm | None, selector: str | Selector = "hard_voting"
) -> UplinkForm:
    """An uplink form by name, or the given one unchanged; None sends tokens by ``selector``.

    Raises:
        UnknownMethodError: no selector or picture coding of that name.
        DependencyError: the coding needs a package that is not installed.
    """
    if uplink is None:
        name = selector if isinstance(selector, str) else None
        return TokenUplink(make_selector(selector), name)
    if not isinstance(uplink, str):
        return uplink
    made = find_entry(uplink).make()
    return TokenUplink(made, uplink) if selects(made) else made


def table() -> str:
    """All rows as lines of text, for ``--help``."""
    rows = [(name, entry.summary) for name, entry in selectors().items()]
    rows += [
        (f"{name}[-{entry.number.split()[0][0].upper()}]" if entry.number else name, entry.summary)
        for name, entry in IMAGE_FORMS.items()
    ]
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"  {name:{width}}  {summary}" for name, summary in rows)


def selects(made: Selector | UplinkForm) -> TypeIs[Selector]:
    """Whether this is a selector, and not a whole uplink form."""
    return hasattr(made, "rank")


def _offered(value: str) -> Callable[..., Any]:
    """A factory that imports what an entry point names when it is first wanted, not when it is listed."""
    return lambda: _imported(value)()


def _imported(name: str) -> Callable[..., Any]:
    module, _, attribute = name.partition(":")
    # A command does not look into the folder that it is called from; whoever names a module expects it.
    if "" not in sys.path:
        sys.path.append("")
    try:
        made = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise UnknownMethodError(
            f"cannot find {name!r} ({error}): name it as package.module:ClassName, importable from here"
        ) from error
    except Exception as error:  # whatever a stranger's module does
        raise UnknownMethodError(
            f"cannot import the module {module!r} of {name!r} ({_cause(error)}): mend it, then try again"
        ) from error
    if not callable(made):
        raise UnknownMethodError(f"{name!r} is no class, but {made!r}")

    @functools.wraps(made, updated=())
    def make() -> Any:
        try:
            return made()
        except ComVLAError:
            raise
        except TypeError as error:
            raise UnknownMethodError(
                f"cannot make one of {name!r} ({_cause(error)}): expected a class, or a function, that takes no "
                "arguments; give its arguments defaults, or name a function that calls it"
            ) from error
        except Exception as error:
            raise UnknownMethodError(
                f"cannot make one of {name!r} ({_cause(error)}): mend it, then try again"
            ) from error

    return make


def _cause(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"
