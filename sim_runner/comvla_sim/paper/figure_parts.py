"""The document's sections about Figs. 3 to 5."""

from __future__ import annotations

from collections.abc import Sequence

from comvla_sim.figures.series import SERIES
from comvla_sim.paper.part import PICTURES, Part
from comvla_sim.paper.published import FIG4_OBJECT_5DB_RICIAN, FIG5_CLAIM
from comvla_sim.paper.results import Json, Results
from comvla_sim.report.tables import Table, rate_with_interval


def figure3(found: Json) -> Part:
    """Which tokens are kept: the pictures, and what can be counted on them."""
    rows = [
        (
            line["method"],
            str(line["k"]),
            "–" if line["overlap"] is None else f"{100 * line['overlap']:.0f} %",
            f"{line['object_kept']} of {line['instructions']}",
        )
        for line in found["overlaps"]
    ]
    words = [
        "One picture, several instructions. What is bright crosses the link; a ring marks the thing that the words "
        "name. "
        "The paper shows one instruction of LIBERO; its votes gather on hand, object and goal, its random "
        "tokens anywhere; whether these do is to be seen, and counted in the table below.",
    ]
    pictures = [PICTURES["fig3"]]
    film = found["film"]
    if film:
        ended = "until it is done" if film["success"] else "which it does not finish"
        words.append(
            f"The film is one episode of “{film['instruction']}” with {film['k']} tokens a query, {film['queries']} "
            "queries, "
            f"{ended}: above what the cameras see, below what was sent last."
        )
        pictures.append(PICTURES["film"])
    table = Table(
        "Kept tokens on this picture",
        "Share of the K kept tokens that two of the instructions have in common, and for how many instructions the "
        "named "
        "thing's token is among them. One picture: an illustration, no statistic; over all frames see Table I's last "
        "column.",
        ("method", "K", "in common", "named thing kept"),
        tuple(rows),
    )
    return Part("Fig. 3: which tokens are kept", words, [table], pictures)


def sweeps(results: Results) -> list[Part]:
    """Figs. 4 and 5, as far as they were measured."""
    found = []
    for key, title, words, across, head in (
        (
            "fading",
            "Fig. 4: success under fading",
            f"The text of the paper gives two numbers of its figure: {FIG4_OBJECT_5DB_RICIAN['hard_voting']:.1f} % "
            "for ComVLA "
            f"and {FIG4_OBJECT_5DB_RICIAN['random']:.1f} % for random tokens (Object suite, Rician, 5 dB). “Not "
            "enforced” is "
            "its simulation: K follows the reported SNR, and everything arrives. The other lines run over a link that "
            "really withholds what does not fit.",
            "mean_snr_db",
            "{:g} dB",
        ),
        (
            "csi-delay",
            "Fig. 5: stale channel state",
            f"The paper says that stale reports “{FIG5_CLAIM}”, without numbers. d is the age of the report in control "
            "periods.",
            "csi_delay",
            "d = {}",
        ),
    ):
        sweep = results.data.get(key)
        if not sweep or not sweep["points"]:
            continue
        tables = [
            _sweep_table(channel, sweep["points"], across, head)
            for channel in dict.fromkeys(p["axes"]["channel"] for p in sweep["points"])
        ]
        more = "More lines, what the link did, and a picture are in [fading.md](fading.md)."
        caption = " ".join(sweep["caption"].split("\n"))
        found.append(Part(title, [words, caption, more], tables))
    return found


def _sweep_table(channel: str, points: Sequence[Json], across: str, head: str) -> Table:
    own = [point for point in points if point["axes"]["channel"] == channel]
    columns = sorted({point["axes"][across] for point in own})
    cells = {(p["series"], p["axes"][across]): p for p in own}
    rows = []
    for name in dict.fromkeys(point["series"] for point in own):
        line = [cells.get((name, column)) for column in columns]
        counts = sorted({point["episodes"] for point in line if point})
        rows.append(
            (
                SERIES[name].label,
                *("–" if point is None else rate_with_interval(point) for point in line),
                " to ".join(map(str, dict.fromkeys((counts[0], counts[-1])))),
            )
        )
    return Table(
        f"{channel.capitalize()} fading",
        "Percent of episodes with Wilson's 95 % intervals.",
        ("line", *(head.format(column) for column in columns), "episodes a point"),
        tuple(rows),
    )
