"""The front door: help, exit codes, and messages instead of tracebacks."""

from __future__ import annotations

import subprocess
import sys

import pytest

from comvla.errors import LinkError
from comvla_sim import cli


@pytest.mark.parametrize("command", sorted(cli.COMMANDS))
def test_every_command_explains_itself(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as leaving:
        cli.main([command, "--help"])
    assert leaving.value.code == 0
    assert f"comvla-sim {command}" in capsys.readouterr().out


def test_without_a_command_it_lists_them(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([]) == 2
    printed = capsys.readouterr().out
    assert all(command in printed for command in cli.COMMANDS)


def test_it_knows_its_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("comvla ")


def test_a_missing_module_names_itself_and_blocks_nobody_else(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(cli.COMMANDS, "bench", "comvla_sim.no_such_module")
    assert cli.main(["bench", "edge"]) == 2
    assert "no_such_module" in capsys.readouterr().err
    with pytest.raises(SystemExit) as leaving:
        cli.main(["report", "--help"])
    assert leaving.value.code == 0


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (LinkError("no such link"), 2),
        (ModuleNotFoundError("No module named 'matplotlib'", name="matplotlib"), 2),
        (KeyboardInterrupt(), 130),
        (BrokenPipeError(), 1),
    ],
)
def test_errors_that_a_user_can_mend_are_messages(
    error: BaseException,
    code: int,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    from comvla_sim.report import command

    def fail(args: object) -> int:
        raise error

    monkeypatch.setattr(command, "run", fail)
    assert cli.main(["report", "anything"]) == code
    assert "Traceback" not in capsys.readouterr().err


def test_help_needs_neither_torch_nor_a_simulator() -> None:
    code = (
        "import sys\n"
        "from comvla_sim import cli\n"
        "cli.build_parser()\n"
        "heavy = {'torch', 'mujoco', 'matplotlib', 'metaworld'} & set(sys.modules)\n"
        "sys.exit(str(heavy) if heavy else 0)\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
