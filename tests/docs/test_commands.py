"""Every command of the documentation is one that the programs understand."""

from __future__ import annotations

import argparse
import re
import shlex
import subprocess
from collections.abc import Callable

import markdown
import pytest

import comvla_client.cli
import comvla_server.cli
import comvla_sim.cli

PARSERS: dict[str, Callable[[], argparse.ArgumentParser]] = {
    "comvla": comvla_client.cli.build_parser,
    "comvla-server": comvla_server.cli.build_parser,
    "comvla-sim": comvla_sim.cli.build_parser,
}

_COMMAND = re.compile(r"comvla(?:-server|-sim)? [a-z].*")


def _commands() -> list[str]:
    found = []
    for page in markdown.PAGES:
        for block in markdown.blocks(page, "console"):
            lines = [line[2:] for line in block.code.splitlines() if line.startswith("$ ")]
            found += [line for line in lines if _COMMAND.fullmatch(line)]
        spans = re.findall(r"`([^`\n]+)`", markdown.prose(page))
        found += [span for span in spans if _COMMAND.fullmatch(span)]
    return sorted(set(found))


COMMANDS = _commands()


def test_the_documentation_names_every_program() -> None:
    assert {shlex.split(command)[0] for command in COMMANDS} == set(PARSERS)


@pytest.mark.parametrize("command", [c for c in COMMANDS if len(c.split()) > 2])
def test_command_with_its_arguments_is_understood(command: str) -> None:
    program, *arguments = shlex.split(command, comments=True)
    PARSERS[program]().parse_args(arguments)


@pytest.mark.parametrize("command", sorted({" ".join(c.split()[:2]) for c in COMMANDS}))
def test_command_has_help(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    program, subcommand = command.split()
    with pytest.raises(SystemExit) as ending:
        PARSERS[program]().parse_args([subcommand, "--help"])
    assert ending.value.code == 0
    assert "usage:" in capsys.readouterr().out


def test_make_lists_every_target_and_contributing_explains_it() -> None:
    done = subprocess.run(
        ["make", "-C", str(markdown.ROOT)], capture_output=True, text=True, check=True
    )
    listed = re.findall(r"^  make (\S+) +\S", done.stdout, re.MULTILINE)
    targets = "help demo test lint bench image-check proto train-mini libero"
    assert listed == targets.split()
    explained = {row[0] for row in markdown.table(markdown.ROOT / "CONTRIBUTING.md", "command")}
    assert explained == {f"`make {target}`" for target in listed if target != "help"}
