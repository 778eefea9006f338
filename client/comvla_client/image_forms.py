"""Ways of sending pictures, by name: codings of files and video, and learned codecs."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from comvla.images.stills import STILL_CODINGS
from comvla_client.image_encoders import ImageEncoder, StillEncoder, VideoEncoder
from comvla_client.image_uplink import ImageUplink
from comvla_client.symbol_uplink import SymbolUplink
from comvla_client.uplink import UplinkForm

if TYPE_CHECKING:
    from typing_extensions import TypeIs


@dataclass(frozen=True)
class ImageEntry:
    """A picture coding of the table; its name may carry a number, as in ``jpeg-75``.

    Attributes:
        make: an encoder, or a whole uplink form, for that number, or for None where there is none.
        number: what the number is; empty where the coding takes none.
        summary: one line, for ``--help`` and tables.
        source: where it comes from.
    """

    make: Callable[[int | None], ImageEncoder | UplinkForm]
    number: str
    summary: str
    source: str


def _still(coding: str) -> Callable[[int | None], ImageEncoder]:
    return lambda quality: StillEncoder(coding, quality)


def _video(crf: int | None) -> ImageEncoder:
    return VideoEncoder() if crf is None else VideoEncoder(crf)


def _symbols(codec: str) -> Callable[[int | None], UplinkForm]:
    return lambda snr_db: SymbolUplink(codec, snr_db)


IMAGE_FORMS: dict[str, ImageEntry] = {
    **{
        coding: ImageEntry(
            _still(coding),
            "quality 1 to 100",
            f"{coding.upper()} pictures, vision in the cloud; without a number the link decides the quality",
            "Pillow",
        )
        for coding in STILL_CODINGS
    },
    "h264": ImageEntry(
        _video,
        "rate factor 0 to 51",
        "H.264 over time, vision in the cloud; 23 without a number",
        "x264, by PyAV",
    ),
    "deepjscc": ImageEntry(
        _symbols("deepjscc"),
        "SNR in dB",
        "symbols of a learned convolutional codec; without a number at the reported SNR",
        "Bourtsoulatze et al., 2019",
    ),
    "witt": ImageEntry(
        _symbols("witt"),
        "SNR in dB",
        "symbols of a learned Swin transformer; without a number at the reported SNR",
        "Yang et al., 2023",
    ),
}
"""Picture codings of an uplink, by name."""

_IMAGE_NAME = re.compile(r"(?P<coding>[a-z][a-z0-9_]*)(?:-(?P<number>\d+))?")


def split_name(name: str) -> tuple[ImageEntry, int | None] | None:
    """The row and the number of a name such as ``jpeg-75``; None where it is no picture coding."""
    parts = _IMAGE_NAME.fullmatch(name)
    if parts is None or parts["coding"] not in IMAGE_FORMS:
        return None
    entry, number = IMAGE_FORMS[parts["coding"]], parts["number"]
    if number is not None and not entry.number:
        return None
    return entry, None if number is None else int(number)


def make_image_form(entry: ImageEntry, number: int | None, name: str) -> UplinkForm:
    """A new uplink form.

    Args:
        entry: of the table. number: of the name. name: for reports.

    Raises:
        DependencyError: it needs a package that is not installed.
        ValueError: a number out of range.
    """
    made = entry.make(number)
    return made if _is_form(made) else ImageUplink(made, name)


def _is_form(made: ImageEncoder | UplinkForm) -> TypeIs[UplinkForm]:
    return hasattr(made, "compress")
