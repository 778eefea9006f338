"""Numbers that make no sense end every command with exit code 2 and a line that says what was expected."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator

import pytest
from test_commands import PARSERS

import comvla_client.cli
import comvla_server.cli
import comvla_sim.cli
from comvla.number_arguments import SECONDS, SEED, SNR_DB, number, whole

MAINS: dict[str, Callable[[list[str]], int]] = {
    "comvla": comvla_client.cli.main,
    "comvla-server": comvla_server.cli.main,
    "comvla-sim": comvla_sim.cli.main,
}
# Checked where they belong together, see below.
CHECKED_LATER = {
    "--seconds",
    "--every-s",
    "--bandwidth-hz",
    "--period-s",
    "--efficiency",
    "--reserve-s",
    "--interval-s",
}
NONSENSE = ("nan", "abc", "", "1e", "0x10", "9" * 5000)


def numeric(parser: argparse.ArgumentParser, name: str) -> Iterator[tuple[str, Callable]]:
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for word, inner in action.choices.items():
                yield from numeric(inner, f"{name} {word}")
        elif action.type is not str and getattr(action.type, "__module__", "") in (
            "builtins",
            "comvla.number_arguments",
        ):
            yield f"{name} {action.option_strings[0]}", action.type


OPTIONS = {o: read for name, make in PARSERS.items() for o, read in numeric(make(), name)}


def test_there_are_options_to_look_at() -> None:
    assert len(OPTIONS) > 40
    assert "comvla-sim train --threads" in OPTIONS


@pytest.mark.parametrize("option", sorted(o for o in OPTIONS if o.split()[-1] not in CHECKED_LATER))
def test_nonsense_is_refused_where_it_is_read(option: str) -> None:
    for text in NONSENSE:
        with pytest.raises((argparse.ArgumentTypeError, ValueError)):
            OPTIONS[option](text)


@pytest.mark.parametrize(
    "command",
    [
        "comvla step 127.0.0.1:1 --deadline-s nan",
        "comvla step 127.0.0.1:1 --deadline-s 0",
        "comvla step 127.0.0.1:1 --proprio inf 0",
        "comvla step 127.0.0.1:1 --seed -1",
        "comvla step 127.0.0.1:1 --snr-db nan",
        "comvla step 127.0.0.1:1 --every-s nan",
        "comvla step 127.0.0.1:1 --repeat -1",
        "comvla step 127.0.0.1:1 --bandwidth-hz nan",
        "comvla step 127.0.0.1:1 --period-s inf",
        "comvla doctor 127.0.0.1:1 --connect-timeout-s nan",
        "comvla doctor 127.0.0.1:1 --seconds inf",
        "comvla doctor 127.0.0.1:1 --calls 0",
        "comvla doctor 127.0.0.1:1 --efficiency nan",
        "comvla doctor 127.0.0.1:1 --reserve-s nan",
        "comvla snr constant --interval-s nan",
        "comvla snr constant --interval-s inf",
        "comvla-server serve --threads 0",
        "comvla-server serve --default-deadline-s nan",
        "comvla-server serve --grace-s inf",
        "comvla-server serve --fastv nan,nan",
        "comvla-server serve --max-batch 1e9",
        "comvla-server token new me --file tokens --requests-per-s nan",
        "comvla-server split SRC DST --views 0",
        "comvla-server split SRC DST --horizon -8",
        "comvla-sim train --threads 0",
        "comvla-sim train --workers -1",
        "comvla-sim train --random-share nan",
        "comvla-sim train --seed -1",
        "comvla-sim demo --mean-snr-db nan",
        "comvla-sim demo --episodes 0",
        "comvla-sim demo --seed -1",
        "comvla-sim eval --workers -1",
        "comvla-sim eval --k 0",
        "comvla-sim eval --seed -1",
        "comvla-sim bench model --threads -1",
        "comvla-sim bench edge --threads 0",
        "comvla-sim libero expert --episodes 0",
    ],
)
def test_the_command_ends_with_two_and_a_line(
    command: str, capsys: pytest.CaptureFixture[str], tmp_path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    program, *arguments = command.split()
    try:
        code = MAINS[program](arguments)
    except SystemExit as end:
        code = int(end.code or 0)
    assert code == 2
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert last.startswith(program)


def test_what_is_accepted() -> None:
    assert whole(1, 5)("5") == 5
    assert number(-1, 1)("-1") == -1
    assert SNR_DB("-inf") == -float("inf")
    assert SEED("0") == 0
    for read, text in (
        (whole(1, 5), "6"),
        (number(0, 1, above_low=True), "0"),
        (number(), "inf"),
        (SNR_DB, "inf"),
        (SECONDS, "0"),
    ):
        with pytest.raises(argparse.ArgumentTypeError, match="expected a"):
            read(text)
