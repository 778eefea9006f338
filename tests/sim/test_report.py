"""``comvla-sim report``: tables, plots and a page that loads nothing."""

from __future__ import annotations

import io
import json
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from eval_stubs import made_up_row
from rich.console import Console

from comvla_sim import cli
from comvla_sim.experiments.link_case import LinkCase
from comvla_sim.experiments.summary import summarise
from comvla_sim.report.tables import Table
from comvla_sim.report.terminal import print_summary


class Links(HTMLParser):
    """Collects everything in a page that a browser would fetch."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.targets: list[str] = []
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: Sequence[tuple[str, str | None]]) -> None:
        names = ("src", "href", "srcset", "data", "poster", "action")
        self.targets += [value or "" for name, value in attrs if name in names]


def rows(**settings: Any) -> list[dict[str, Any]]:
    made = [
        made_up_row(method=method, k=k, task=task, episode=e, success=e < wins, **settings)
        for method, k, wins in (("full", 512, 5), ("hard_voting", 32, 5), ("hard_voting", 16, 4))
        for task in ("drawer-open", "lever-down")
        for e in range(5)
    ]
    misled = made_up_row(condition="wrong_instruction", success=False, other_success=True)
    return [*made, {**misled, "settings": made[0]["settings"]}]


def write(path: Path, lines: Sequence[dict[str, Any]]) -> str:
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    return str(path)


def test_a_report_has_tables_and_plots_and_loads_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, out = write(tmp_path / "a.jsonl", rows()), tmp_path / "report"
    assert cli.main(["report", f"votes={file}", "--out", str(out)]) == 0
    assert "report.html" in capsys.readouterr().out
    html = (out / "report.html").read_text()
    assert all(target.startswith("data:") for target in Links(html).targets)
    assert "default-src 'none'" in html
    text = (out / "report.md").read_text()
    assert "| hard_voting | – | 100.0 (72.2–100.0) | 80.0 (49.0–94.3) |" in text
    assert "| wrong_instruction: hard_voting 16 | 0.0 (0.0–79.3) | 100.0 (20.7–100.0) |" in text
    for plot in re.findall(r"!\[[^]]*\]\(([^)]+)\)", text):
        ElementTree.parse(out / plot)
    assert len(list(out.glob("*.svg"))) == 2


@pytest.mark.parametrize(
    ("links", "words"),
    [
        ([None], "a link that loses nothing."),
        ([LinkCase()], "the links that the tables name."),
        ([None, LinkCase()], "a link that loses nothing, and over the links that the tables name."),
    ],
)
def test_a_report_says_what_the_tokens_crossed(
    tmp_path: Path, links: list[LinkCase | None], words: str
) -> None:
    file = write(tmp_path / "a.jsonl", [made_up_row(link=link) for link in links])
    assert cli.main(["report", file, "--out", str(tmp_path / "report")]) == 0
    text = (tmp_path / "report" / "report.md").read_text()
    assert f"tokens sent as int8 over {words}" in text


def test_equal_results_give_equal_plots(tmp_path: Path) -> None:
    file = write(tmp_path / "a.jsonl", rows())
    for name in ("one", "two"):
        assert cli.main(["report", f"votes={file}", "--out", str(tmp_path / name)]) == 0
    for plot in (tmp_path / "one").glob("*.svg"):
        assert plot.read_bytes() == (tmp_path / "two" / plot.name).read_bytes()


def test_seeds_are_put_together_and_models_are_not(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = [
        write(tmp_path / "a.jsonl", rows(seed=1)),
        write(tmp_path / "b.jsonl", rows(seed=2)),
        write(tmp_path / "c.jsonl", rows(seed=1, model_fingerprint="feedbeef" * 2)),
    ]
    assert cli.main(["report", *files, "--out", str(tmp_path / "out"), "--json"]) == 0
    groups = json.loads(capsys.readouterr().out)["groups"]
    episodes = {name: group["aggregate"][0]["episodes"] for name, group in groups.items()}
    assert sorted(episodes.values()) == [10, 20]
    assert any("feedbeef" in name for name in episodes)


def test_one_name_cannot_hold_two_models(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    a = write(tmp_path / "a.jsonl", rows())
    b = write(tmp_path / "b.jsonl", rows(model_fingerprint="feedbeef" * 2))
    assert cli.main(["report", f"mini={a}", f"mini={b}", "--out", str(tmp_path / "out")]) == 2
    assert "NAME=FILE" in capsys.readouterr().err


def test_no_results_no_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    empty = write(tmp_path / "empty.jsonl", [])
    assert cli.main(["report", empty, "--out", str(tmp_path / "out")]) == 2
    assert "no results" in capsys.readouterr().err
    assert cli.main(["report", str(tmp_path / "missing"), "--out", str(tmp_path / "out")]) == 2
    blocked = write(tmp_path / "a.jsonl", rows())
    assert cli.main(["report", blocked, "--out", blocked]) == 2
    assert "cannot write" in capsys.readouterr().err


def test_text_from_results_is_text_on_the_page(tmp_path: Path) -> None:
    table = Table("a & b", "x < y", ("<script>", "n"), (("<img src=x>", "1|2"),))
    assert "<script>" not in table.html()
    assert "<img" not in table.html()
    assert "1\\|2" in table.markdown()


def test_the_terminal_shows_what_the_json_says() -> None:
    screen = io.StringIO()
    print_summary(summarise(rows()), Console(width=200, file=screen))
    text = screen.getvalue()
    assert re.search(r"hard_voting +16 +8/10 +80\.0 ", text)
    assert re.search(r"hard_voting +16 +4 +4\b", text)
    assert "wrong_instruction: successes" in text
    assert "McNemar" in text


def test_an_episode_in_two_files_counts_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = rows()
    first, both = write(tmp_path / "a.jsonl", made[:8]), write(tmp_path / "b.jsonl", made)
    other_seed = write(tmp_path / "c.jsonl", rows(seed=1))
    arguments = ["report", first, both, other_seed, "--json", "--out", str(tmp_path / "report")]
    assert cli.main(arguments) == 0
    captured = capsys.readouterr()
    (summary,) = json.loads(captured.out)["groups"].values()
    counted = {(r["method"], r["k"]): r["episodes"] for r in summary["aggregate"]}
    assert counted["full", 512] == 20, "ten of each seed"
    assert "b.jsonl: 8 of 31 episodes stand in a file before it" in captured.err
