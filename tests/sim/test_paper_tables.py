"""The paper's numbers as they are quoted, what is calculated beside them, and which cells stand for them."""

from __future__ import annotations

import pytest

from comvla_client import registry
from comvla_sim.experiments.methods import find_method
from comvla_sim.paper import analytic
from comvla_sim.paper.cells import GROUPS, PAPER_CELLS, TABLE1_GROUPS, Cell, ordered
from comvla_sim.paper.published import SUITES, TABLE1, TABLE2, TABLE3, TABLE4
from comvla_vla.presets import openvla_oft


def test_every_line_of_table_1_has_a_cell_that_is_measured() -> None:
    measured = {cell for group in TABLE1_GROUPS for cell in group}
    assert set(PAPER_CELLS) <= measured
    assert set(PAPER_CELLS.values()) == set(TABLE1)


def test_every_selector_that_takes_a_number_of_tokens_has_a_cell_at_every_k_of_the_table() -> None:
    measured = {cell for group in TABLE1_GROUPS for cell in group}
    for name in set(registry.SELECTORS) - {"hard_voting_random_ties"}:  # a control of its own page
        if not find_method(name).decides_itself:
            assert {Cell(name, k) for k in (128, 64, 48, 32, 16, 8)} <= measured, name


def test_every_cell_names_a_method_that_exists() -> None:
    for cell in {cell for groups in GROUPS.values() for group in groups for cell in group}:
        assert find_method(cell.method).decides_itself == (cell.k is None), cell.name


def test_cells_that_tables_share_are_measured_once_and_what_matters_most_first() -> None:
    groups = ordered(("table1", "table2", "table3", "table4"))
    cells = [cell for group in groups for cell in group]
    assert len(cells) == len(set(cells))
    assert Cell("full") in groups[0]
    assert {Cell("hard_voting", k) for k in (128, 64, 48, 32, 16, 8)} <= set(groups[0])
    assert {Cell("random", k) for k in (128, 64, 48, 32, 16, 8)} <= set(groups[0])
    assert {cell.quantization for cell in cells} == {"int8", "int4", "float16"}


def test_the_quoted_averages_are_those_of_their_suites_but_for_one_misprint() -> None:
    lines = [(x.success, x.average) for x in TABLE1.values()]
    lines += [(success, average) for success, average in TABLE3.values()]
    lines += [(success, average) for _, success, average in TABLE4.values()]
    wrong = [average for success, average in lines if abs(sum(success) / 4 - average) > 0.0501]
    assert wrong == [96.0]
    assert all(len(success) == len(SUITES) for success, _ in lines)
    (named,) = (x for x in analytic.inconsistencies() if x.startswith("Averages"))
    assert "ComVLA K=48 (95.90 printed as 96.0)" in named


def test_the_papers_kilobytes_are_calculated_exactly() -> None:
    for (method, k), line in TABLE1.items():
        if k is not None:
            assert analytic.payload_kib(k, "int8") == line.kib
        if method in analytic.PICTURE_SIDE:
            assert analytic.codec_kib(method) == line.kib
    assert analytic.payload_kib(512, "int8") == TABLE1["full", None].kib
    for quantization, (kib, _, _) in TABLE4.items():
        assert analytic.payload_kib(32, quantization) == kib
    assert analytic.implied_tokens(TABLE1["lightvla", None]) == pytest.approx(77.8, abs=0.05)


def test_operations_fit_the_papers_but_for_k_128() -> None:
    off = {
        key
        for key, line in TABLE1.items()
        if not (span := analytic.as_counted_by_the_paper(*key)).low - 0.05
        <= line.tflops
        <= span.high + 0.05
    }
    assert off == {("hard_voting", 128), ("random", 128)}


def test_no_one_prompt_gives_both_numbers_of_the_language_model() -> None:
    """The counts that the two printed numbers need, worked out by hand from Eq. (5)."""
    b = openvla_oft().backbone

    def tflops(s: float) -> float:
        layer = 8 * s * b.hidden**2 + 4 * s * s * b.hidden + 6 * s * b.hidden * b.intermediate
        return b.layers * layer / 1e12

    assert tflops(512 + 88.7) == pytest.approx(TABLE2["OpenVLA-OFT"]["vlm"][0], abs=0.005)
    assert tflops(32 + 80.2) == pytest.approx(TABLE2["ComVLA"]["vlm"][0], abs=0.005)
    first = analytic.inconsistencies()[0]
    assert "need 88.7" in first
    assert "need 80.2" in first
    assert "78 to 96" in first


def test_what_crosses_the_wire_is_a_little_more_than_the_papers_payload() -> None:
    for k in (512, 128, 32, 16):
        payload, wire = analytic.payload_kib(k, "int8"), analytic.wire_kib(k, "int8")
        assert payload < wire < 1.02 * payload + 0.6
