"""docs/results.md and the HTML page: made of the results alone, so that equal results give equal documents."""

from __future__ import annotations

from comvla_sim.paper import analytic, claims, costs, tables2to4
from comvla_sim.paper.cells import Cell
from comvla_sim.paper.changes import change
from comvla_sim.paper.figure_parts import figure3, sweeps
from comvla_sim.paper.part import PICTURES, Part
from comvla_sim.paper.published import PAPER, TABLE1
from comvla_sim.paper.results import Results
from comvla_sim.paper.table1 import counted_verdicts
from comvla_sim.paper.table1 import tables as table1
from comvla_sim.paper.verdicts import AGREES, DIFFERS, OURS, UNTESTED
from comvla_sim.report.tables import Table

TITLE = "Results: the paper's tables and figures, measured here"

WANTED_EPISODES = 20
"""Layouts for each instruction and method that a full run has."""


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
                [*table1(results), *costs.tables(results)],
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
        found.append(figure3(data["figure3"]))
    found += sweeps(results)
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
        f"from the paper ({PAPER}), everything else was measured or calculated by the command in this repository.\n"
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
        f"{story['episodes']} layouts of the table wanted for each instruction and method, evaluation seed "
        f"{story['seed']}, "
        f"{_same_tables(results)} Training never saw them. One evaluation seed and one training seed: intervals cover "
        "the layouts, not the training, and take the instructions of one layout as independent.",
        f"- Policy {settings['model']}, fingerprint `{settings['model_fingerprint']}`; INT8 tokens unless a line says "
        "otherwise; a link that loses nothing in the tables, fading in Figs. 4 and 5.",
        f"- {wall_h:.1f} hours of wall time in episodes on {machine['cpu']} ({machine['cores']} cores); "
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
    missing = results.data.get("missing", [])
    if missing:
        words.append(f"- **Not measured yet**: {', '.join(missing)}.")
    if short:
        listed = ", ".join(f"{cell.name} ({count})" for cell, count in short)
        words.append(
            f"- **Not complete yet**, with fewer than {_complete(results)} episodes: {listed}. Their intervals are "
            "wider for "
            "it; the same command goes on where it stopped."
        )
    return Part("What was run", words)


def _same_tables(results: Results) -> str:
    if results.same_tables:
        return "the same layouts for every method."
    return (
        "the same layouts as far as both were run, and differences between two methods are taken on those that "
        "both have."
    )


def _complete(results: Results) -> int:
    wanted: int = results.story["episodes"] * len(results.story["tasks"]) * len(results.suites)
    return wanted


def _in_short(results: Results) -> list[str]:
    measured, calculated = (_counts(part) for part in _tables(results))
    words = [
        f"Of the cells below on success, which were measured, {measured}. Of those on bytes, operations and latency, "
        f"most of which are calculated at the paper's sizes, {calculated}.",
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


def _counts(shown: list[Table]) -> str:
    texts = list(counted_verdicts(shown))
    agree, differ, untested, ours = (
        sum(text.startswith(kind) for text in texts) for kind in (AGREES, DIFFERS, UNTESTED, OURS)
    )
    return (
        f"{agree} agree with the paper, {differ} differ, {untested} cannot be tested here, and {ours} are not in the "
        "paper"
    )


def _tables(results: Results) -> tuple[list[Table], list[Table]]:
    """Tables on success, and those on what a query costs."""
    cost = tables2to4.table2(results)
    if not results.data["cells"]:
        return [], cost
    success = [*table1(results), *tables2to4.table3(results), *tables2to4.table4(results)]
    return success, [*cost, *costs.tables(results)]


def _table1_words(results: Results) -> list[str]:
    words = []
    ours = change(results, Cell("random", 32), Cell("full"))
    theirs = TABLE1["random", 32].average - TABLE1["full", None].average
    mini = results.story["settings"]["model"] == "comvla-mini"
    if ours is not None and mini and ours < theirs:
        words.append(
            "Random tokens fall deeper here than in the paper. This policy never saw them in training, and its tokens "
            "see "
            "a field of 16 pixels, where a token of OpenVLA-OFT has attended to its whole picture and may know what "
            "lies "
            "elsewhere. The fair control, a policy trained on random tokens half of the time, is in the "
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
        "round to zero. The features that OpenVLA-OFT sends are un-normalised and have such channels; that would "
        "explain the "
        "paper's drop, and a scale for each channel would avoid it."
    ]


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
