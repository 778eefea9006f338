"""docs/results.md and the HTML page: made of the results alone, so that equal results give equal documents."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from comvla_sim.figures.series import SERIES
from comvla_sim.paper import analytic, claims, tables2to4
from comvla_sim.paper.cells import Cell
from comvla_sim.paper.published import FIG4_OBJECT_5DB_RICIAN, FIG5_CLAIM
from comvla_sim.paper.results import Json, Results
from comvla_sim.paper.table1 import counted_verdicts
from comvla_sim.paper.table1 import tables as table1
from comvla_sim.paper.verdicts import AGREES, DIFFERS, OURS, UNTESTED
from comvla_sim.report.tables import Table, rate_with_interval

TITLE = "Results: the paper's tables and figures, measured here"

WANTED_EPISODES = 20
"""Layouts for each instruction and method that a full run has."""

PICTURES = {
    "table1": ("results-bytes.svg", "Success against bytes on the wire, every method"),
    "fig3": ("results-tokens.png", "Kept tokens by instruction, method and K"),
    "film": ("results-episode.webp", "Kept tokens over an episode"),
}
"""File in docs/ and what it shows."""


@dataclass(frozen=True)
class Part:
    """One section.

    Attributes:
        title: heading.
        words: paragraphs.
        tables: in reading order.
        pictures: keys of :data:`PICTURES`, or names of other files in docs/ with what they show.
    """

    title: str
    words: Sequence[str] = ()
    tables: Sequence[Table] = ()
    pictures: Sequence[tuple[str, str]] = field(default=())


def parts(results: Results) -> list[Part]:
    """All sections for which there are results."""
    data = results.data
    found = [_story(results)]
    found.append(Part("In short", _in_short(results), [claims.table(results)]))
    if data["cells"]:
        found.append(
            Part(
                "Table I: every method",
                _table1_words(results),
                table1(results),
                [PICTURES["table1"]],
            )
        )
    found.append(Part("Table II: parts of one query", (), tables2to4.table2(results)))
    if data["cells"]:
        found.append(Part("Table III: hard against soft voting", (), tables2to4.table3(results)))
        found.append(
            Part("Table IV: number formats", _table4_words(results), tables2to4.table4(results))
        )
    if data.get("figure3"):
        found.append(_figure3(data["figure3"]))
    found += _sweeps(results)
    found.append(
        Part(
            "What does not fit together in the paper",
            ["Found by calculating its columns from its own equations and from the model's sizes:"]
            + [f"- {line}" for line in analytic.inconsistencies()],
        )
    )
    found.append(_renewing(results))
    return found


def markdown(results: Results) -> str:
    """docs/results.md."""
    head = (
        f"# {TITLE}\n\nWritten by `comvla-sim paper all`; not to be edited by hand. Columns headed *paper* are quoted "
        "from the paper, everything else was measured or calculated by the command in this repository.\n"
    )
    return "\n".join([head, *(_markdown(part) for part in parts(results))])


def _markdown(part: Part) -> str:
    lines = [f"## {part.title}\n"]
    previous = ""
    for words in part.words:
        listed = words.startswith("- ") and previous.startswith("- ")
        if previous and not listed:
            lines.append("")
        lines.append(words)
        previous = words
    if part.words:
        lines.append("")
    for file, what in part.pictures:
        lines.append(f"![{what}]({file})\n")
    lines += [table.markdown() for table in part.tables]
    return "\n".join(lines)


def _story(results: Results) -> Part:
    story = results.story
    settings, machine = story["settings"], story["machine"]
    episodes = sum(c["episodes"] for c in results.data["cells"])
    wall_h = sum(c["wall_s"] for c in results.data["cells"]) / 3600
    versions = {**settings["versions"], **story["packages"]}
    world = "LIBERO's four suites" if results.libero else f"the world `{story['world']}`"
    words = [
        f"- {episodes} episodes of {len(results.cells)} ways of sending in {world}, {len(story['tasks'])} "
        "instructions, "
        f"{story['episodes']} tables wanted for each instruction and method, evaluation seed {story['seed']}, the same "
        "tables for every method. Training never saw them. One evaluation seed and one training seed: intervals cover "
        "the "
        "tables, not the training.",
        f"- Policy {settings['model']}, fingerprint `{settings['model_fingerprint']}`; INT8 tokens unless a line says "
        "otherwise; a link that loses nothing in the tables, fading in Figs. 4 and 5.",
        f"- {wall_h:.1f} hours of one core of {machine['cpu']} ({machine['cores']} cores, shared with other work); "
        "Python "
        f"{machine['python']}, "
        + ", ".join(f"{name} {number}" for name, number in versions.items())
        + ".",
    ]
    if results.stand_in:
        words.append(
            "- Drawn with stand-in assets: nothing here may be compared with published success rates."
        )
    short = [
        (cell, found["episodes"])
        for cell in results.cells
        if (found := results.find(cell)) and found["episodes"] < _complete(results)
    ]
    if short:
        listed = ", ".join(f"{cell.name} ({count})" for cell, count in short)
        words.append(
            f"- **Not complete yet**, with fewer than {_complete(results)} episodes: {listed}. Their intervals are "
            "wider for "
            "it; the same command goes on where it stopped."
        )
    return Part("What was run", words)


def _complete(results: Results) -> int:
    wanted: int = results.story["episodes"] * len(results.story["tasks"]) * len(results.suites)
    return wanted


def _in_short(results: Results) -> list[str]:
    shown = [table for part in _tables(results) for table in part]
    texts = list(counted_verdicts(shown))
    counts = {
        kind: sum(text.startswith(kind) for text in texts)
        for kind in (AGREES, DIFFERS, UNTESTED, OURS)
    }
    words = [
        f"Of the cells that the tables below hold, {counts[AGREES]} agree with the paper, {counts[DIFFERS]} differ, "
        f"{counts[UNTESTED]} cannot be tested here, and {counts[OURS]} are not in the paper.",
    ]
    if not results.libero:
        words += [
            "This is another world with another, far smaller policy: levels of success are never to be compared with "
            "the "
            "paper's. What can be compared is what a method *changes*: how much success it costs to send fewer "
            "tokens, or "
            "to choose them otherwise. Bytes and operations are calculated at the paper's own sizes.",
            "The votes of this policy were trained with positions that only a simulator knows. That they work says "
            "that "
            "grounded voting works; it says nothing about whether voting emerges in OpenVLA-OFT by itself. "
            "`comvla-sim paper all --world libero --model PATH` measures that where somebody has its published "
            "weights.",
        ]
    return words


def _tables(results: Results) -> list[list[Table]]:
    found = [tables2to4.table2(results)]
    if results.data["cells"]:
        found += [table1(results), tables2to4.table3(results), tables2to4.table4(results)]
    return found


def _table1_words(results: Results) -> list[str]:
    words = []
    full, random32 = results.find(Cell("full")), results.find(Cell("random", 32))
    if full and random32 and not results.libero:
        words.append(
            "Random tokens fall far deeper here than in the paper. This policy never saw them in training, and a token "
            "here sees a field of 16 pixels, where the paper's sees the whole picture: a random token of OpenVLA-OFT "
            "still "
            "knows what is elsewhere. The fair control, a policy trained on random tokens half of the time, is in the "
            "[model card](../vla/comvla_vla/policies/mini/README.md): 90.6 % with 32 random tokens against 97.5 % "
            "with 32 "
            "voted ones."
        )
    words.append(
        "Pictures decide their own bytes, so they have no K. LightVLA and VLA-ADP decide their own number of tokens; "
        "their "
        "weights here are this policy's, which was not trained for either. FastV drops tokens in the cloud and saves "
        "no "
        "bytes. The learned codecs are at 10 dB in every period; their bytes are latents in float32, as the paper "
        "counts, "
        "which are not what crosses the air ([codecs.md](codecs.md))."
    )
    return words


def _table4_words(results: Results) -> list[str]:
    found = results.data.get("layers")
    if not found:
        return []
    four, massive = found["formats"]["int4"], found["formats"]["int4 massive"]
    return [
        "The codec has one scale for each token (and tower): the largest value decides how coarse the steps are. The "
        "tokens "
        f"of this policy have no massive channels, so INT4 is off by {100 * four['layers'][0]['error']:.0f} % at the "
        "link and "
        f"by {100 * four['layers'][-1]['error']:.0f} % behind the last layer. Make one of 96 channels "
        f"{found['massive']:g} "
        "times as large, which changes nothing but the scale, and INT4 is off by "
        f"{100 * massive['layers'][1]['error']:.0f} % "
        f"behind the projector and {100 * massive['layers'][-1]['error']:.0f} % behind the last layer: all other "
        "channels "
        "round to zero. The features that OpenVLA-OFT sends are un-normalised and have such channels; that explains "
        "the "
        "paper's drop, and a scale for each channel would avoid it."
    ]


def _figure3(found: Json) -> Part:
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
        "The paper shows one instruction of LIBERO; that votes gather on hand, object and goal, and random tokens "
        "anywhere, "
        "agrees with it.",
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


def _sweeps(results: Results) -> list[Part]:
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


def _renewing(results: Results) -> Part:
    episodes = results.story["episodes"]
    return Part(
        "To measure it again",
        [
            "```console\n"
            f"$ comvla-sim paper all --episodes {episodes} --docs docs\n"
            "$ comvla-sim paper all --quick\n"
            "$ comvla-sim paper all --world libero --model ./oft-{suite}\n"
            "```",
            "The first runs what is missing in runs/paper and writes this page with its pictures and results.json; "
            "stopped "
            "at any time, it goes on where it was. `--measured-only` writes the page from what is there. The second "
            "takes "
            "minutes and has wide intervals. How a verdict is reached: the paper's number and ours are compared with "
            "the "
            "interval of their difference (MOVER, from Wilson's intervals, 95 %), the paper's counted as 500 episodes "
            "a "
            "suite; calculated numbers agree where the paper's digits lie within the range that LIBERO's prompts "
            "give. A "
            "wide interval agrees easily: read it with the verdict.",
        ],
    )
