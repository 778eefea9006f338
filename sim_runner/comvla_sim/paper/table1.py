"""Table I: success of every method, and hard voting against random tokens."""

from __future__ import annotations

from collections.abc import Iterator

from comvla_sim.experiments.methods import order, shown_k
from comvla_sim.experiments.statistics import p_text
from comvla_sim.paper.cells import BUDGETS, PAPER_CELLS, Cell
from comvla_sim.paper.changes import (
    ALL_EPISODES,
    SOME_SUITES,
    STAND_IN,
    change,
    change_text,
    change_verdict,
    gap_text,
)
from comvla_sim.paper.published import (
    EPISODES_PER_SUITE,
    SUITE_NAMES,
    SUITES,
    TABLE1,
    PaperLine,
)
from comvla_sim.paper.results import Results
from comvla_sim.paper.verdicts import (
    OURS,
    UNTESTED,
    Rate,
    Verdict,
    compare_rates,
)
from comvla_sim.report.tables import Table

DASH = "–"
FULL = Cell("full")
OTHER_LEVEL = Verdict(
    UNTESTED,
    "the level belongs to world and policy; the others are compared by their change from it",
)
OTHER_MACHINE = Verdict(UNTESTED, "needs an H100 and the 7.5 G model")
OTHER_WEIGHTS = Verdict(UNTESTED, "how many tokens it keeps depends on trained weights")


def lines(results: Results) -> list[tuple[Cell, PaperLine | None]]:
    """The paper's lines in its order, then what it does not have."""
    own = [cell for cell in results.cells if cell.quantization == "int8"]
    known = [(cell, TABLE1[key]) for cell, key in PAPER_CELLS.items()]
    more = sorted(
        (cell for cell in own if cell not in PAPER_CELLS),
        key=lambda c: (order(c.method), -(c.k or 0)),
    )
    return [*known, *((cell, None) for cell in more)]


def shown(cell: Cell) -> str:
    """K for a table."""
    if cell.method == "full":
        return "512"
    if cell.pictures:
        return DASH
    return "own" if cell.k is None else shown_k(cell.method, cell.k)


def rate_text(rate: Rate | None) -> str:
    """Percent with Wilson's interval."""
    if rate is None:
        return DASH
    low, high = rate.interval
    return f"{100 * rate.value:.1f} ({100 * low:.1f}–{100 * high:.1f})"


def success_verdict(
    results: Results, cell: Cell, reference: Cell, paper: PaperLine | None, suite: str | None
) -> Verdict:
    """Here against the paper: the rates in the paper's own world, elsewhere their change from the reference."""
    if paper is None:
        return Verdict(OURS)
    ours = results.rate(cell, suite)
    if ours is None:
        return Verdict(UNTESTED, "not measured yet")
    if results.stand_in:
        return STAND_IN
    if suite is None and results.some_suites:
        return SOME_SUITES
    if results.libero:
        return compare_rates(_published(paper, suite), ours)
    if cell == reference:
        return OTHER_LEVEL
    if results.rate(reference, suite) is None:
        return Verdict(UNTESTED, "its reference is not measured yet")
    level = TABLE1[PAPER_CELLS[reference]]
    printed = _percent(paper, suite), _percent(level, suite)
    return change_verdict(results, (cell, reference), printed, suite)


def _published(line: PaperLine, suite: str | None) -> Rate:
    episodes = EPISODES_PER_SUITE if suite in SUITES else ALL_EPISODES
    return Rate.of_percent(_percent(line, suite), episodes)


def tables(results: Results) -> list[Table]:
    """Success by method and K, and votes against random tokens; what a query costs is in :mod:`.costs`."""
    places: list[str | None] = [None, *results.suites] if results.libero else [None]
    return [
        *(_success(results, suite) for suite in places),
        _against_random(results),
    ]


def _success(results: Results, suite: str | None) -> Table:
    where = f", {SUITE_NAMES[suite]}" if suite else ""
    rows = []
    for cell, paper in lines(results):
        ours = results.rate(cell, suite)
        theirs = None if paper is None else _percent(paper, suite)
        level = _percent(TABLE1["full", None], suite)
        found = results.find(cell, suite)
        moved = change(results, cell, FULL, suite) if ours else None
        rows.append(
            (
                cell.method,
                shown(cell),
                DASH if theirs is None else f"{theirs:.1f}",
                DASH if theirs is None else change_text(theirs - level),
                rate_text(ours),
                DASH if moved is None else change_text(moved),
                success_verdict(results, cell, FULL, paper, suite).text,
                DASH if ours is None else str(ours.episodes),
                _hits(found),
            )
        )
    return Table(
        f"Success{where}",
        "Percent of episodes, with Wilson's 95 % interval; change in points from all 512 tokens, on the layouts that "
        "both were run on. K is “own” where a method decides itself how much it sends; “named thing kept” is how often "
        "a token of the thing that the instruction names was among those sent. "
        + (
            "The verdict compares the rates."
            if results.libero
            else "The paper's column is its average over LIBERO's four suites, 2000 episodes; its columns Spatial, "
            "Object, Goal and Long cannot be tested in this world. The verdict compares the changes, because world "
            "and policy are others: it agrees unless the two changes differ beyond chance (95 %)."
        ),
        (
            "method",
            "K",
            "paper",
            "change",
            "here",
            "change",
            "verdict",
            "episodes",
            "named thing kept, %",
        ),
        tuple(rows),
    )


def _percent(line: PaperLine, suite: str | None) -> float:
    return line.success[SUITES.index(suite)] if suite in SUITES else line.average


def _hits(found: dict[str, object] | None) -> str:
    rate = None if found is None else found["object_hit_rate"]
    pictures = found is not None and Cell(str(found["method"])).pictures
    return DASH if not isinstance(rate, float) or pictures else f"{100 * rate:.1f}"


def _against_random(results: Results) -> Table:
    rows = []
    for k in (*BUDGETS, 4):
        hard, lot = Cell("hard_voting", k), Cell("random", k)
        ours, test = results.shared(hard, lot), results.pair(hard, lot)
        if ours is None or test is None:
            continue
        theirs = [TABLE1.get((method, k)) for method in ("hard_voting", "random")]
        gap, verdict = DASH, Verdict(OURS)
        if theirs[0] and theirs[1]:
            printed = theirs[0].average, theirs[1].average
            gap = change_text(printed[0] - printed[1])
            verdict = change_verdict(results, (hard, lot), printed)
        rows.append(
            (
                f"K = {k}",
                gap,
                gap_text(ours),
                str(test["pairs"]),
                str(test["only_first"]),
                str(test["only_second"]),
                p_text(test["p_value"], 1),
                verdict.text,
            )
        )
    return Table(
        "Hard voting against random tokens at equal K",
        "Points of success by which hard voting is ahead on the layouts that both were run on; how many pairs that "
        "are, and in how many only one of the two succeeded (exact McNemar test, two-sided, not corrected for the "
        "number of tests).",
        ("", "paper", "here", "pairs", "only hard voting", "only random", "p", "verdict"),
        tuple(rows),
    )


def counted_verdicts(tables_: list[Table]) -> Iterator[str]:
    """The verdict column of every table that has one."""
    for table in tables_:
        if "verdict" in table.header:
            column = table.header.index("verdict")
            yield from (row[column] for row in table.rows)
