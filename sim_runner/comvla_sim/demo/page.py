"""The demo as one HTML file that needs nothing else."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from html import escape
from importlib.resources import files
from typing import Any

from comvla.model_info import ModelInfo
from comvla_client import LinkProfile
from comvla_sim.demo.episode import Episode
from comvla_sim.demo.figures import Figures, LinkUse, query_line
from comvla_sim.report.page import POLICY, shared_style

# Sent for a period without a link: JSON has no minus infinity.
_NO_LINK_DB = -60.0


def render(
    episodes: Sequence[Episode],
    references: Sequence[Episode],
    figures: Figures,
    full: Figures,
    use: LinkUse,
    *,
    info: ModelInfo,
    link: LinkProfile,
    mean_snr_db: float,
    seed: int,
    command: str,
) -> str:
    """The whole page.

    Args:
        episodes: with films.
        references: the same with every token on a link without limit.
        figures: over the fading link.
        full: of the references; its ``air_s`` is what they would have taken on the fading link.
        use: whether the link's limit was kept.
        info: the model.
        link: the radio.
        mean_snr_db: of the channel.
        seed: of the demo.
        command: what to type to see it again.
    """
    data = {
        "grid": info.grid,
        "period_s": link.period_s,
        "num_tokens": info.num_tokens,
        "episodes": [_episode(episode) for episode in episodes],
    }
    parts = {
        "POLICY": POLICY,
        "STYLE": shared_style() + _asset("page.css"),
        "HEADLINE": f"{figures.successes} of {figures.episodes} instructions obeyed",
        "LEAD": _lead(figures, info, link, mean_snr_db),
        "TILES": _tiles(figures, full, use),
        "CARDS": "".join(_card(number, episode) for number, episode in enumerate(episodes)),
        "TABLE": _table(figures, full),
        "EPISODES": _episodes_table(episodes, references),
        "NOTES": _notes(use, info, link, mean_snr_db, seed),
        "COMMAND": escape(command),
        # "<" would end the script element if a text contained "</script>".
        "DATA": json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c"),
        "SCRIPT": _asset("page.js"),
    }
    html = _asset("page.html")
    for name, text in parts.items():
        html = html.replace(f"<!--{name}-->", text, 1)
    return html


def _asset(name: str) -> str:
    return files("comvla_sim.demo").joinpath(name).read_text(encoding="utf-8")


def _episode(episode: Episode) -> dict[str, Any]:
    return {
        "frames": [[period, uri] for period, uri in episode.frames],
        "queries": [query_line(query) for query in episode.queries],
        "snr": [round(v, 1) if math.isfinite(v) else _NO_LINK_DB for v in episode.snr_db],
        "capacity": [round(bits / 8) for bits in episode.capacity_bits],
        "periods": episode.periods,
    }


def _lead(figures: Figures, info: ModelInfo, link: LinkProfile, mean_snr_db: float) -> str:
    return (
        f"A simulated arm is driven by <b>{escape(info.name)}</b>, cut in two. The robot’s half "
        f"turns two cameras into {info.num_tokens} tokens, lets the words of the instruction vote, "
        f"and sends the {figures.tokens:.0f} most voted ones (on average), as many as the fading "
        f"link carries in {1000 * link.period_s:.0f} ms. A server finishes the forward pass and "
        f"answers with {info.action_horizon} actions. Mean SNR {mean_snr_db:g} dB."
    )


def _kib(count: float) -> str:
    return f"{count / 1024:.1f} KiB"


def _ms(seconds: float | None) -> str:
    if seconds is None:
        return "–"
    return f"{1000 * seconds:.0f} ms" if math.isfinite(seconds) else "never"


def _tiles(figures: Figures, full: Figures, use: LinkUse) -> str:
    ratio = full.wire_bytes / figures.wire_bytes if figures.wire_bytes else math.inf
    tiles = [
        (f"{figures.successes}/{figures.episodes}", "episodes succeeded"),
        (_kib(figures.wire_bytes), "on the wire per query"),
        (f"{ratio:.1f}×" if math.isfinite(ratio) else "–", "fewer bytes than all tokens"),
        (f"{use.above_capacity} of {use.requests}", "requests above the link’s capacity"),
    ]
    return "".join(
        f'<div class="tile"><b>{escape(value)}</b><span>{escape(label)}</span></div>'
        for value, label in tiles
    )


def _card(number: int, episode: Episode) -> str:
    outcome = ("good", "done") if episode.success else ("bad", "not done")
    instruction = escape(episode.scene.task.instruction)
    return f"""
<article class="card" data-episode="{number}">
  <header>
    <h2>“{instruction}”</h2>
    <span class="badge {outcome[0]}">{outcome[1]} · {episode.periods} steps</span>
  </header>
  <div class="player" tabindex="0" role="group" aria-label="Film of “{instruction}”">
    <div class="views"><canvas role="img" aria-label="camera from the side"></canvas><canvas role="img"
      aria-label="camera from above"></canvas></div>
    <p class="readout" aria-live="off"></p>
    <div class="controls">
      <button type="button" class="play" aria-label="play">▶</button>
      <input type="range" class="scrub" min="0" value="0" step="1" aria-label="time">
      <select class="speed" aria-label="speed"><option value="0.5">½×</option>
        <option value="1" selected>1×</option><option value="2">2×</option></select>
      <select class="marks" aria-label="tokens"><option value="spot" selected>spotlight</option>
        <option value="line">outline</option><option value="off">picture only</option></select>
    </div>
  </div>
  <div class="charts"></div>
</article>"""


def _table(figures: Figures, full: Figures) -> str:
    def row(name: str, *values: str) -> str:
        cells = "".join(f"<td>{escape(value)}</td>" for value in values)
        return f'<tr><th scope="row">{escape(name)}</th>{cells}</tr>'

    def flops(value: float) -> str:
        return f"{value / 1e6:.1f} MFLOP"

    both = (figures, full)
    spread = f"{figures.tokens:.0f} ({figures.tokens_min}–{figures.tokens_max})"
    rows = [
        row("Success", *(f"{f.successes} of {f.episodes}" for f in both)),
        row("Tokens per query", spread, f"{full.tokens:.0f}"),
        row("Payload per query (K·D·B/8)", *(_kib(f.payload_bytes) for f in both)),
        row("On the wire per query", *(_kib(f.wire_bytes) for f in both)),
        row("On the wire per episode", *(_kib(f.episode_bytes) for f in both)),
        row(
            "Time on this link’s air per query", _ms(figures.air_s), f"{_ms(full.air_s)} (computed)"
        ),
        row("Computing and local call per query", *(_ms(f.compute_s) for f in both)),
        row("Robot’s computation per query", *(flops(f.edge_flops) for f in both)),
        row("Cloud’s computation per query", *(flops(f.cloud_flops) for f in both)),
        row("Periods held without an answer", *(str(f.holds) for f in both)),
    ]
    head = "<th></th><th scope='col'>voted tokens, fading link</th>"
    head += "<th scope='col'>all tokens, link without limit</th>"
    return f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>"


def _episodes_table(episodes: Sequence[Episode], references: Sequence[Episode]) -> str:
    def cells(episode: Episode) -> str:
        outcome = ("good", "done") if episode.success else ("bad", "not done")
        sent = sum(query.report.framed_bytes for query in episode.queries)
        return (
            f'<td class="{outcome[0]}">{outcome[1]}</td><td>{episode.periods}</td>'
            f"<td>{_kib(sent)}</td>"
        )

    rows = "".join(
        f'<tr><th scope="row">{escape(episode.scene.task.instruction)}</th>'
        f"{cells(episode)}{cells(reference)}</tr>"
        for episode, reference in zip(episodes, references, strict=True)
    )
    ways = "".join(
        f"<th scope='colgroup' colspan='3'>{way}</th>"
        for way in ("voted tokens, fading link", "all tokens, link without limit")
    )
    names = "<th scope='col'>outcome</th><th scope='col'>steps</th><th scope='col'>sent</th>"
    return (
        f"<table><thead><tr><th></th>{ways}</tr><tr><th scope='col'>instruction</th>{2 * names}</tr>"
        f"</thead><tbody>{rows}</tbody></table>"
    )


def _notes(use: LinkUse, info: ModelInfo, link: LinkProfile, mean_snr_db: float, seed: int) -> str:
    notes = [
        f"Link: Rician fading, K-factor 3, Doppler 10 Hz, mean SNR {mean_snr_db:g} dB, bandwidth "
        f"{link.bandwidth_hz / 1e6:g} MHz, control period {1000 * link.period_s:g} ms, efficiency "
        f"{link.efficiency:g}. The bandwidth is the paper’s 20 MHz scaled to this model’s small "
        "tokens, so that the number of tokens that fit is the same.",
        "Every byte counts, protobuf, gRPC and HTTP/2 framing included: the largest of "
        f"{use.requests} requests came to {100 * use.largest_share:.1f} % of what its period "
        f"carried. The link withholds whatever exceeds the capacity; {use.above_capacity} requests "
        "did. The robot knows the SNR of the period in which it sends.",
        "Time on the air is simulated; computing is measured on the machine that ran the demo, over "
        "a local connection. For all tokens it is the time that their bytes would have needed on "
        "the same fading link.",
        f"The film is drawn larger than the {info.image_size[1]} px pictures that the policy sees. "
        "Marked cells are the tokens that the cloud received last; brighter frames were ranked "
        "higher.",
        f"The tables were never used in training. Seed {seed}; model {escape(info.name)}, "
        f"fingerprint {escape(info.fingerprint)}. A handful of episodes shows how it works, not how "
        "well: comvla-sim eval measures that.",
    ]
    return "".join(f"<li>{note}</li>" for note in notes)
