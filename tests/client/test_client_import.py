"""Importing the SDK costs little and never touches torch."""

from __future__ import annotations

import subprocess
import sys
import textwrap

import pytest

PREREQUISITES = "import numpy, grpc"
WITHOUT_TORCH = """
    import sys

    class NoTorch:
        def find_spec(self, name, path=None, target=None):
            if name.partition(".")[0] in ("torch", "comvla_vla", "comvla_server", "comvla_sim"):
                raise ImportError(f"{name} is not installed here")

    sys.meta_path.insert(0, NoTorch())
"""


def run_python(code: str, *arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code), *arguments],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def seconds_to_import(statement: str) -> float:
    code = f"import time; t = time.perf_counter(); {statement}; print(time.perf_counter() - t)"
    return min(float(run_python(code)) for _ in range(3))


@pytest.mark.alone
def test_import_costs_less_than_half_a_second_more_than_numpy_and_grpc() -> None:
    extra_s = seconds_to_import(f"{PREREQUISITES}, comvla_client") - seconds_to_import(
        PREREQUISITES
    )
    assert extra_s < 0.5


def test_everything_of_the_sdk_imports_without_torch() -> None:
    run_python(
        WITHOUT_TORCH
        + """
    import pkgutil, comvla_client
    for module in pkgutil.walk_packages(comvla_client.__path__, "comvla_client."):
        if not module.name.endswith("__main__"):
            __import__(module.name)
    assert "torch" not in sys.modules
    """
    )


def test_a_robot_without_torch_votes_selects_and_sizes() -> None:
    out = run_python(
        WITHOUT_TORCH
        + """
    import numpy as np
    from comvla_client import LinkProfile, token_budget
    from comvla_client.scoring import hard_importance
    from comvla_client.selection import select
    rng = np.random.default_rng(0)
    importance = hard_importance(rng.standard_normal((5, 8)), rng.standard_normal((40, 8)))
    print(len(select(importance, token_budget(10.0, LinkProfile(), 2176 * 64))))
    """
    )
    assert out.strip() == "9"


@pytest.mark.parametrize("command", ["doctor", "step"])
def test_the_command_line_teaches_without_torch(command: str) -> None:
    code = WITHOUT_TORCH + "\n    from comvla_client.cli import main\n    main(sys.argv[1:])\n"
    assert "HOST:PORT" in run_python(code, command, "--help")


def test_stepping_without_torch_says_what_to_install() -> None:
    code = (
        WITHOUT_TORCH
        + "\n    from comvla_client.cli import main\n    sys.exit(main(sys.argv[1:]))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code), "step", "127.0.0.1:1"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert "pip install 'comvla[edge]'" in done.stderr


def test_import_does_nothing_but_define() -> None:
    out = run_python(
        """
    import logging, threading
    import comvla_client
    print(logging.getLogger().handlers, threading.active_count())
    """
    )
    assert out.strip() == "[] 1"
