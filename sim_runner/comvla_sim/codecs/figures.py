"""Curves and pictures for people."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from comvla_sim.codecs.digital import QUALITIES, JpegLadder
from comvla_sim.codecs.fidelity import psnr_db
from comvla_sim.codecs.measuring import reconstruct
from comvla_sim.report.plots import COLOURS, MARKERS
from comvla_vla.codecs.files import TrainedCodec
from comvla_vla.codecs.image_codec import Rate

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_STYLES = {"awgn": "-", "rician": "--", "rayleigh": ":"}
_KINDS = {"awgn": "AWGN", "rician": "Rician κ=3", "rayleigh": "Rayleigh"}
_SHOWN_QUALITIES = (5, 20, 50, 75, 95)
_SHOWN_SNRS_DB = (0.0, 5.0, 10.0, 20.0)

CAPTION = (
    "JPEG (grey): sent by an ideal code that reaches the capacity of as many uses of an AWGN channel "
    "as the codec takes, k·log2(1+SNR) bits, with the SNR known and tables agreed upon; what does not "
    "fit counts as a grey picture. Real codes lose 1 to 3 dB of SNR, and fading more. Bytes on the right "
    "are not comparable with symbols: a float32 latent is analogue, its bytes only how the paper counts it."
)


@dataclass(frozen=True)
class Measured:
    """A codec with its curves.

    Attributes:
        trained: the codec. rate: of one picture.
        lines: of :func:`comvla_sim.codecs.measuring.curves`.
    """

    trained: TrainedCodec
    rate: Rate
    lines: list[dict[str, Any]]

    def line(self, kind: str) -> list[dict[str, Any]]:
        """The curve of one kind of channel."""
        return [line for line in self.lines if line["channel"] == kind]


def psnr_figure(codecs: Sequence[Measured], ladder: JpegLadder, form: str) -> bytes:
    """PSNR over the SNR at equal channel uses (left) and over bytes (right), in ``form`` svg or png."""
    import matplotlib
    from matplotlib.figure import Figure

    settings: Any = {"svg.fonttype": "none", "svg.hashsalt": "comvla", "font.size": 9}
    with matplotlib.rc_context(settings):
        figure = Figure(figsize=(10.0, 5.0), layout="constrained")
        left, right = figure.subplots(1, 2, sharey=True)
        _over_snr(left, codecs, ladder)
        _over_bytes(right, codecs, ladder)
        figure.supxlabel(_wrapped(CAPTION), fontsize=7, x=0.01, ha="left")
        return _saved(figure, form)


def _over_snr(axes: Axes, codecs: Sequence[Measured], ladder: JpegLadder) -> None:
    for number, codec in enumerate(codecs):
        for kind, style in _STYLES.items():
            line = codec.line(kind)
            axes.plot(
                [point["mean_snr_db"] for point in line],
                [point["psnr_db"] for point in line],
                style,
                color=COLOURS[number],
                marker=MARKERS[number],
                markersize=4,
                label=f"{codec.trained.name}, {_KINDS[kind]}",
            )
        uses = codec.rate.channel_uses
        snrs = [point["mean_snr_db"] for point in codec.line("awgn")]
        ideal = [ladder.at_capacity(uses, snr)[0] for snr in snrs]
        axes.plot(
            snrs,
            ideal,
            color="0.55",
            linestyle=("-", "--", ":")[number % 3],
            label=f"JPEG, {uses} uses",
        )
    axes.set_xlabel("mean SNR, dB")
    axes.set_ylabel("PSNR on held-out tables, dB")
    axes.grid(alpha=0.25)
    axes.legend(frameon=False, fontsize=7)
    axes.set_title("equal channel uses", fontsize=9)


def _over_bytes(axes: Axes, codecs: Sequence[Measured], ladder: JpegLadder) -> None:
    kib = ladder.file_bytes.mean(1) / 1024
    ratios = ladder.psnr_db.mean(1)
    axes.plot(kib, ratios, color="0.35", marker=".", label="JPEG, whole files")
    for quality in _SHOWN_QUALITIES:
        at = QUALITIES.index(quality)
        axes.annotate(
            f"q{quality}",
            (kib[at], ratios[at]),
            textcoords="offset points",
            xytext=(4, -9),
            fontsize=7,
        )
    for number, codec in enumerate(codecs):
        line = codec.line("awgn")
        axes.scatter(
            [codec.rate.latent_bytes / 1024] * len(line),
            [point["psnr_db"] for point in line],
            color=COLOURS[number],
            marker=MARKERS[number],
            s=16,
            label=f"{codec.trained.name}, float32 latent, AWGN "
            f"{line[0]['mean_snr_db']:g} to {line[-1]['mean_snr_db']:g} dB",
        )
    axes.set_xscale("log", base=2)
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.set_xlabel("KiB for one picture")
    axes.grid(alpha=0.25)
    axes.legend(frameon=False, fontsize=7)
    axes.set_title("bytes as the paper counts them", fontsize=9)


def pictures_figure(
    codecs: Sequence[TrainedCodec],
    pictures: npt.NDArray[np.uint8],
    kind: str = "awgn",
    snrs_db: Sequence[float] = _SHOWN_SNRS_DB,
) -> bytes:
    """A PNG: originals on the left, reconstructions at several SNR to their right.

    Args:
        codecs: a group of rows each.
        pictures: (n, H, W, 3), a row each.
        kind: of channel. snrs_db: a column each.
    """
    from matplotlib.figure import Figure

    rows, columns = len(codecs) * len(pictures), 1 + len(snrs_db)
    figure = Figure(figsize=(1.9 * columns, 2.1 * rows), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False)
    for number, trained in enumerate(codecs):
        seen = [reconstruct(trained.codec, pictures, kind, snr) for snr in snrs_db]
        for index, original in enumerate(pictures):
            cells = grid[number * len(pictures) + index]
            _show(cells[0], original, "original")
            for cell, snr, shown in zip(cells[1:], snrs_db, seen, strict=True):
                ratio = float(psnr_db(original[None], shown[index][None])[0])
                _show(cell, shown[index], f"{trained.name} at {snr:g} dB\n{ratio:.1f} dB PSNR")
    return _saved(figure, "png")


def _show(axes: Axes, picture: npt.NDArray[np.uint8], title: str) -> None:
    axes.imshow(picture, interpolation="nearest")
    axes.set_title(title, fontsize=8)
    axes.axis("off")


def _saved(figure: Figure, form: str) -> bytes:
    buffer = io.BytesIO()
    metadata = {"Date": None} if form == "svg" else None
    figure.savefig(buffer, format=form, metadata=metadata, dpi=100)
    return buffer.getvalue()


def _wrapped(text: str) -> str:
    import textwrap

    return "\n".join(textwrap.wrap(text, 190))
