"""Every way of telling the cloud what the robot sees that can be evaluated, by name.

The client's table (:mod:`comvla_client.registry`) with what only a server can do added to it; whatever is
registered there, or named as ``package.module:ClassName``, is a method here.
"""

from __future__ import annotations

import functools
import hashlib
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from comvla_client import registry
from comvla_client.selection import FullTransmission, Selector
from comvla_client.token_uplink import TokenUplink
from comvla_client.uplink import UplinkForm

if TYPE_CHECKING:
    from comvla_vla import CloudOptions


@dataclass(frozen=True)
class Method:
    """One row of the comparison.

    Attributes:
        name: as asked for.
        summary, equation, source: as in :class:`comvla_client.registry.Entry`.
        make: gives a new uplink form, or a selector that makes one.
        in_cloud: what it needs of a cloud half of so many layers; None for nothing.
        server_option: the same for ``comvla-server serve``.
    """

    name: str
    summary: str
    equation: str
    source: str
    make: Callable[..., Selector | UplinkForm]
    in_cloud: Callable[[int], CloudOptions] | None = None
    server_option: str = ""

    def form(self) -> UplinkForm:
        """A new uplink form.

        Raises:
            DependencyError: it needs a package that is not installed.
        """
        made = self.make()
        return TokenUplink(made, self.name) if registry.selects(made) else made

    def selector(self) -> Selector | None:
        """A new selector like the form's; None where pictures are sent."""
        if sends_pictures(self.name):
            return None
        made = self.make()
        if registry.selects(made):
            return made
        return made.selector if isinstance(made, TokenUplink) else None

    @functools.cached_property
    def source_sha256(self) -> str:
        """Digest of the file that defines a class of one's own, read once; empty for what has a name here.

        What that file imports is not looked at.
        """
        module, own, _ = self.name.partition(":")
        if not own:
            return ""
        modules = (sys.modules.get(name) for name in sorted({module, self.make.__module__}))
        files = [file for m in modules if (file := getattr(m, "__file__", None)) is not None]
        return hashlib.sha256(b"".join(Path(file).read_bytes() for file in files)).hexdigest()

    @functools.cached_property
    def listens(self) -> bool:
        """Whether the instruction decides what is sent."""
        selector = self.selector()
        return selector is not None and selector.uses_language

    @functools.cached_property
    def decides_itself(self) -> bool:
        """Whether it has one size of its own, so that several K make no difference."""
        selector = self.selector()
        return selector is None or selector.sends_all


def _fastv(layers: int) -> CloudOptions:
    from comvla_vla import CloudOptions, FastV

    # Its authors' third layer is the last but one of the small policy's three: behind the last nothing is saved.
    return CloudOptions(fastv=FastV(layer=min(FastV().layer, layers - 1)))


IN_CLOUD = (
    Method(
        "fastv",
        "all tokens cross the link, 75 % are dropped inside the backbone",
        "top (1 − R) N by α of the last row at layer K − 1; K = 3, R = 0.75",
        "FastV (pkunlp-icler/FastV)",
        FullTransmission,
        _fastv,
        "--fastv 3,0.75",
    ),
)
"""What only a cloud half can do."""


def methods() -> dict[str, Method]:
    """All that have a name, in the order of tables; picture codings without their number."""
    found = {
        name: Method(name, entry.summary, entry.equation, entry.source, entry.make)
        for name, entry in registry.selectors().items()
    }
    found |= {method.name: method for method in IN_CLOUD}
    return found | {name: find_method(name) for name in registry.IMAGE_FORMS}


@functools.cache
def find_method(name: str) -> Method:
    """The method of a name: a row of the table, a picture coding, or ``package.module:ClassName``.

    Raises:
        UnknownMethodError: there is none; the message lists those that exist.
    """
    for method in IN_CLOUD:
        if method.name == name:
            return method
    try:
        entry = registry.find_entry(name)
    except registry.UnknownMethodError as error:
        also = ", ".join(method.name for method in IN_CLOUD)
        raise registry.UnknownMethodError(f"{error} (and in evaluations {also})") from error
    method = Method(name, entry.summary, entry.equation, entry.source, entry.make)
    _ = method.source_sha256  # read with the module: the file may be edited while episodes run
    return method


def sends_pictures(name: str) -> bool:
    """Whether a name is that of a picture coding, with its number or without."""
    return name.partition("-")[0] in registry.IMAGE_FORMS


def order(name: str) -> tuple[int, str]:
    """Sort key of tables: what is compared with first, then the table's order, then everything else."""
    if name == "full":
        return -1, name
    known = list(methods())
    place = name if name in known else name.partition("-")[0]
    return (known.index(place) if place in known else len(known)), name


def shown_k(name: str, k: int | None) -> str:
    """K as a table shows it: a dash where it means nothing, because the method decides itself what it sends."""
    if k is None:
        return "link"
    if sends_pictures(name):
        return "–"
    # Nothing of anybody else's is imported to print a table.
    if name == "full" or name not in registry.SELECTORS:
        return str(k)
    return "own" if find_method(name).decides_itself else str(k)


def table() -> str:
    """All methods as lines of text, for ``--help``."""
    return "\n".join([registry.table(), *(f"  {m.name:23}  {m.summary}" for m in IN_CLOUD)])
