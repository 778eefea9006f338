"""docs/selectors.md adds a selector: its very text becomes a file, and its command runs it."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path

import markdown
import pytest

from comvla_client import registry
from comvla_sim import cli
from comvla_sim.worlds.tabletop import Tabletop

GUIDE = markdown.ROOT / "docs" / "selectors.md"


@pytest.fixture
def centre(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """``centre.py`` as the guide prints it, in the folder that the user is in."""
    monkeypatch.chdir(tmp_path)
    (block,) = markdown.blocks(GUIDE, "python")
    file = tmp_path / "centre.py"
    file.write_text(block.code, encoding="utf-8")
    yield file
    sys.modules.pop("centre", None)
    registry.SELECTORS.pop("centre", None)


def test_a_selector_takes_less_than_thirty_lines(centre: Path) -> None:
    assert len(centre.read_text().splitlines()) < 30


@pytest.mark.simulator
def test_the_command_of_the_guide_evaluates_it_beside_the_others(
    centre: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(Tabletop, "max_episode_steps", 8)
    (command,) = (
        line.removeprefix("$ comvla-sim ")
        for block in markdown.blocks(GUIDE, "console")
        for line in block.code.splitlines()
        if line.startswith("$ comvla-sim eval") and "centre" in line
    )
    short = ["--model", "random", "--instructions", "drawer-open", "--workers", "1", "--json"]
    arguments = [*shlex.split(command), "--episodes", "1", *short]
    assert cli.main(arguments) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [row["method"] for row in rows] == ["full", "hard_voting", "centre:CentreFirst"]
    assert registry.find_entry("centre").source == "this page"
    assert "middle first" in registry.table()
