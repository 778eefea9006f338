"""What the document says about results, and that the committed one is what the command writes."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from paper_stubs import a_few_cells, results, rows

from comvla_sim.experiments.errors import EvaluationError
from comvla_sim.paper import claims
from comvla_sim.paper.cells import Cell
from comvla_sim.paper.document import markdown
from comvla_sim.paper.html import page
from comvla_sim.paper.part import PICTURES
from comvla_sim.paper.plot import success_against_bytes
from comvla_sim.paper.published import SUITES, TABLE1
from comvla_sim.paper.results import Results
from comvla_sim.paper.table1 import tables as table1
from comvla_sim.paper.tables2to4 import table3, table4
from comvla_sim.paper.verdicts import Rate, Verdict
from comvla_sim.report.tables import Table

DOCS = Path(__file__).parents[2] / "docs"


def line(table: Table, *starts: str) -> dict[str, str]:
    """The row that starts so, by column; of equal names the last."""
    (row,) = (row for row in table.rows if row[: len(starts)] == starts)
    return dict(zip(table.header, row, strict=True))


def test_the_committed_document_is_what_its_results_say() -> None:
    committed = Results.load(DOCS / "results.json")
    assert (DOCS / "results.md").read_text(encoding="utf-8") == markdown(committed)


def test_the_committed_pictures_are_there() -> None:
    shown = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", (DOCS / "results.md").read_text(encoding="utf-8"))
    assert {file for file, _ in PICTURES.values()} == set(shown)
    assert all((DOCS / file).is_file() for file in shown)


def test_every_method_stands_beside_the_papers_number_with_a_verdict() -> None:
    success = table1(results(a_few_cells()))[0]
    assert len(success.rows) == len(TABLE1) + 2  # soft voting and JPEG are not in the paper's
    hard = line(success, "hard_voting", "32")
    assert hard["paper"] == "95.4"
    assert hard["verdict"].startswith("agrees")
    assert hard["here"].startswith("95.0 (")
    assert line(success, "random", "32")["verdict"].startswith("differs by -")
    assert line(success, "random", "128")["verdict"] == "cannot be tested here: not measured yet"
    assert line(success, "jpeg-75")["verdict"] == "not in the paper"
    assert "level" in line(success, "full")["verdict"]


def test_votes_are_compared_with_random_tokens_in_pairs() -> None:
    compared = table1(results(a_few_cells()))[1]
    row = line(compared, "K = 32")
    assert (row["pairs"], row["only hard voting"], row["only random"]) == ("40", "34", "0")
    assert float(row["p"]) == pytest.approx(2 / 2**34, rel=0.5)


def test_the_format_that_fails_in_the_paper_is_compared_by_its_change() -> None:
    formats = table4(results(a_few_cells()))[0]
    assert line(formats, "int4")["verdict"].startswith(("agrees", "differs"))
    assert line(formats, "int4")["here, %"].startswith("50.0")
    assert "level" in line(formats, "float16")["verdict"]
    (voting,) = table3(results(a_few_cells()))
    assert line(voting, "K = 32")["only hard : only soft"] == "0 : 0"


def test_an_unfinished_run_says_so_with_its_counts() -> None:
    measured = a_few_cells()
    measured["tabletop", Cell("random", 32)] = rows(Cell("random", 32), 1, 3)
    text = markdown(results(measured))
    assert "**Not complete yet**, with fewer than 40 episodes: random K=32 (6)." in text
    assert "Not complete yet" not in markdown(results(a_few_cells()))


def claimed(made: Results, words: str) -> tuple[str, Verdict]:
    """What came out of the claim that holds these words."""
    ((_, here, verdict),) = (claim for claim in claims.claims(made) if words in claim[0])
    return here, verdict


def test_methods_are_compared_on_the_tables_that_both_were_run_on() -> None:
    """INT8 loses its last table; FP16, stopped before that one, is no better for it."""
    measured = a_few_cells()
    half = Cell("hard_voting", 32, "float16")
    measured["tabletop", half] = rows(half, 5, 5)
    made = results(measured)
    here, _ = claimed(made, "INT8 costs nothing")
    assert here.startswith("0.0 points (")
    assert here.endswith("10 episodes of each")
    int8 = line(table4(made)[0], "int8")
    assert int8["change"] == "0.0"
    assert int8["here, %"].startswith("95.0")
    assert "the same layouts as far as both were run" in markdown(made)
    assert "the same layouts for every method." in markdown(results(a_few_cells()))


def test_as_many_episodes_on_other_tables_are_not_compared() -> None:
    measured = a_few_cells()
    full, lot = Cell("full"), Cell("random", 32)
    seeds = sorted({row["layout_seed"] for row in measured["tabletop", full]})
    for cell, own in ((full, seeds[:10]), (lot, seeds[10:])):
        kept = [row for row in measured["tabletop", cell] if row["layout_seed"] in own]
        measured["tabletop", cell] = kept
    made = results(measured)
    assert made.shared(full, lot) is None
    assert not made.same_tables
    random = line(table1(made)[0], "random", "32")
    assert random["verdict"] == "cannot be tested here: no table was run with both yet"
    assert random["change"] == "–"


def test_shared_rates_are_those_of_either_order_and_of_each_suite() -> None:
    full, hard = Cell("full"), Cell("hard_voting", 32)
    measured = {(suite, full): rows(full, 18, 20, suite) for suite in SUITES}
    measured |= {(suite, hard): rows(hard, 9, 10, suite) for suite in SUITES[:2]}
    made = results(measured, world="libero")
    assert made.shared(hard, full) == (Rate(36, 40), Rate(40, 40))
    assert made.shared(full, hard) == (Rate(40, 40), Rate(36, 40))
    assert made.shared(hard, full, SUITES[0]) == (Rate(18, 20), Rate(20, 20))
    assert made.shared(hard, full, SUITES[2]) is None
    spatial = next(table for table in table1(made) if table.title == "Success, Spatial")
    assert line(spatial, "hard_voting", "32")["change"] == "-10.0"


def test_a_claim_and_the_table_about_it_have_the_same_verdict() -> None:
    measured = a_few_cells()
    for cell in (Cell("deepjscc-10"), Cell("witt-10")):
        measured["tabletop", cell] = rows(cell, 12, 20)
    made = results(measured)
    success, formats = table1(made)[0], table4(made)[0]
    for words, row in (
        ("1.5 points", line(success, "hard_voting", "32")),
        ("Hard votes beat soft", line(table3(made)[0], "K = 32")),
        ("INT8 costs", line(formats, "int8")),
        ("INT4 costs", line(formats, "int4")),
        ("DeepJSCC and WITT", line(success, "deepjscc-10")),
    ):
        assert claimed(made, words)[1].text == row["verdict"], words


def test_what_was_not_measured_makes_no_claim() -> None:
    made = [claim for claim, _, _ in claims.claims(results(a_few_cells()))]
    assert any("1.5 points" in claim for claim in made)
    assert not any("Stale" in claim or "DeepJSCC" in claim for claim in made)


def test_on_the_papers_own_benchmark_rates_are_compared_suite_by_suite() -> None:
    cells = Cell("full"), Cell("hard_voting", 32)
    measured = {(suite, cell): rows(cell, 19, 20, suite) for suite in SUITES for cell in cells}
    tables = table1(results(measured, world="libero"))
    spatial = next(table for table in tables if table.title == "Success, Spatial")
    full = line(spatial, "full")
    assert full["paper"] == "98.4"
    assert full["verdict"].startswith("agrees")
    assert full["episodes"] == "40"
    assert line(tables[0], "full")["episodes"] == "160"


def test_a_part_of_the_benchmark_is_not_compared_with_the_papers_average_over_all_of_it() -> None:
    cells = (Cell("full"), Cell("random", 32))
    suites = ("libero_spatial", "libero_10")
    measured = {(s, cell): rows(cell, 15, 20, s) for s in suites for cell in cells}
    whole, *by_suite = table1(results(measured, world="libero"))
    assert "not all of them were run" in line(whole, "random", "32")["verdict"]
    assert len(by_suite) > len(suites)
    for table in by_suite[: len(suites)]:
        assert "not all of them" not in line(table, "random", "32")["verdict"]


def test_stand_in_pictures_are_compared_with_nothing() -> None:
    measured = {("libero_spatial", Cell("full")): rows(Cell("full"), 5, 5, "libero_spatial")}
    made = results(measured, world="libero")
    made.data["story"]["settings"]["assets"] = "stand-in"
    assert "stand-in" in line(table1(made)[0], "full")["verdict"]


def test_the_plot_has_every_method_and_the_page_loads_nothing(tmp_path: Path) -> None:
    made = results(a_few_cells())
    svg = success_against_bytes(made)
    for name in ("full", "hard_voting K=32", "random K=32", "jpeg-75"):
        assert name.encode() in svg
    (tmp_path / PICTURES["table1"][0]).write_bytes(svg)
    html = page(made, tmp_path)
    assert "data:image/svg+xml" in html
    assert not re.search(r"(src|href)=\"(?!data:|#)", html)


def test_results_of_another_version_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "results.json"
    made = results(a_few_cells())
    made.save(path)
    assert Results.load(path).data == made.data
    path.write_text('{"format": 99}')
    with pytest.raises(EvaluationError, match="format 2"):
        Results.load(path)
    with pytest.raises(EvaluationError, match="cannot read"):
        Results.load(tmp_path / "none.json")
