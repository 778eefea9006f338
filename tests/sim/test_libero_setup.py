"""LIBERO's environment: refused when it is missing or stale, made with one command."""

from __future__ import annotations

import io
import json
import os
import pickle
import stat
import sys
import types
import zipfile
from pathlib import Path

import numpy as np
import pytest

from comvla.errors import DependencyError
from comvla_sim import cli
from comvla_sim.worlds import make
from comvla_sim.worlds.libero import installation
from comvla_sim.worlds.libero.assets import Assets
from comvla_sim.worlds.libero.child import libero_api
from comvla_sim.worlds.libero.child.init_states import read_init_states
from comvla_sim.worlds.libero.child.options import Options
from comvla_sim.worlds.libero.environment import (
    CONSTRAINTS,
    HOME_VARIABLE,
    LiberoEnvironment,
    default_home,
)
from comvla_sim.worlds.libero.errors import AssetsError

FAKE_PYTHON = """#!/bin/sh
# A Python whose venv and pip only note that they were called.
case "$*" in
*version_info*) echo "$FAKE_VERSION" ;;
*venv*) for home; do :; done; mkdir -p "$home/bin"; cp "$0" "$home/bin/python" ;;
*pip*)
    echo "$@" >>"$FAKE_LOG"
    [ -z "$FAKE_PIP_FAILS" ] || { echo "no such package" >&2; exit 1; }
    mkdir -p "${0%/bin/python}/lib/python3.11/site-packages/libero/libero" ;;
esac
"""


@pytest.fixture
def environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> LiberoEnvironment:
    """Not set up yet; ``fake-python`` on the PATH makes it."""
    binaries = tmp_path / "bin"
    binaries.mkdir()
    for name in ("fake-python", "python3.11"):
        (binaries / name).write_text(FAKE_PYTHON)
        (binaries / name).chmod(stat.S_IRWXU)
    monkeypatch.setenv("PATH", f"{binaries}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("FAKE_LOG", str(tmp_path / "log"))
    monkeypatch.setenv("FAKE_VERSION", "3 11")
    monkeypatch.setenv(HOME_VARIABLE, str(tmp_path / "env"))
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    monkeypatch.setattr(Path, "home", lambda: tmp_path / "home")
    return LiberoEnvironment(tmp_path / "env")


def provide_assets(environment: LiberoEnvironment) -> Path:
    for kind in ("scenes", "textures", "articulated_objects", "stable_scanned_objects"):
        (environment.unpacked_assets / kind).mkdir(parents=True)
    return environment.unpacked_assets


def calls(tmp_path: Path) -> list[str]:
    log = tmp_path / "log"
    return log.read_text().splitlines() if log.exists() else []


def test_a_world_without_its_environment_says_how_to_make_it(
    environment: LiberoEnvironment, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(DependencyError, match="run `comvla-sim libero setup`"):
        make("libero:libero_spatial")
    assert cli.main(["libero", "expert"]) == cli.USAGE_ERROR
    assert "comvla-sim libero setup" in capsys.readouterr().err


def test_setting_up_installs_the_exact_list_once(
    environment: LiberoEnvironment, tmp_path: Path
) -> None:
    assets = provide_assets(environment)
    said: list[str] = []
    found = installation.set_up(environment, python="fake-python", say=said.append)
    assert found == Assets(assets, "authentic")
    (call,) = calls(tmp_path)
    assert "--no-deps" in call
    assert str(CONSTRAINTS) in call
    environment.require()
    installation.set_up(environment, python="fake-python", say=said.append)
    assert len(calls(tmp_path)) == 1
    assert any("up to date" in line for line in said)


def test_the_configuration_answers_what_libero_would_ask(environment: LiberoEnvironment) -> None:
    assets = provide_assets(environment)
    installation.set_up(environment, python="fake-python", say=lambda text: None)
    lines = (environment.config_folder / "config.yaml").read_text().splitlines()
    config = {key: json.loads(value) for key, value in (line.split(": ", 1) for line in lines)}
    assert set(config) == {"benchmark_root", "bddl_files", "init_states", "datasets", "assets"}
    assert config["assets"] == str(assets)
    variables = environment.variables(render=True)
    assert variables["LIBERO_CONFIG_PATH"] == str(environment.config_folder)
    assert variables["HF_HUB_OFFLINE"] == "1"


def test_an_installation_that_failed_is_not_taken_for_one(
    environment: LiberoEnvironment, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FAKE_PIP_FAILS", "yes")
    with pytest.raises(DependencyError, match=r"cannot install packages[\s\S]*no such package"):
        installation.set_up(environment, python="fake-python", say=lambda text: None)
    assert not environment.is_ready()


def test_other_pins_make_an_environment_stale(environment: LiberoEnvironment) -> None:
    provide_assets(environment)
    installation.set_up(environment, python="fake-python", say=lambda text: None)
    environment.stamp().write_text('{"constraints_sha256": "of long ago"}')
    with pytest.raises(DependencyError, match="was made from other pins"):
        environment.require()


def test_a_python_that_the_packages_do_not_run_on_is_refused(
    environment: LiberoEnvironment, monkeypatch: pytest.MonkeyPatch
) -> None:
    for version in ("3 13", "3 9", "", "words"):
        monkeypatch.setenv("FAKE_VERSION", version)
        with pytest.raises(DependencyError, match=r"need Python 3\.10 to 3\.12"):
            installation.find_python("fake-python")
    with pytest.raises(DependencyError, match="found none in python-from-the-moon"):
        installation.find_python("python-from-the-moon")


def test_a_python_that_is_too_new_is_passed_over(
    environment: LiberoEnvironment, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(sys, "executable", "/nonexistent/python3.13")
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    assert installation.find_python(None) == str(tmp_path / "bin" / "python3.11")


def test_assets_are_downloaded_only_where_that_was_asked_for(
    environment: LiberoEnvironment, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    asked: list[tuple[str, str, str]] = []

    def snapshot_download(repository: str, *, repo_type: str, local_dir: str) -> None:
        asked.append((repository, repo_type, local_dir))
        for kind in ("scenes", "textures", "articulated_objects", "stable_scanned_objects"):
            (Path(local_dir) / kind).mkdir(parents=True)

    hub = types.SimpleNamespace(snapshot_download=snapshot_download)
    monkeypatch.setitem(sys.modules, "huggingface_hub", hub)
    with pytest.raises(AssetsError, match="no LIBERO assets"):
        installation.set_up(environment, python="fake-python", say=lambda text: None)
    assert asked == []
    cache = tmp_path / "home" / ".cache" / "libero" / "assets"
    found = installation.set_up(
        environment, python="fake-python", download=True, say=lambda text: None
    )
    assert asked == [("lerobot/libero-assets", "dataset", str(cache))]
    assert found == Assets(cache, "authentic")


def test_a_hub_out_of_reach_is_an_error_with_a_remedy(
    environment: LiberoEnvironment, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def snapshot_download(*args: object, **keywords: object) -> None:
        raise OSError("no route to host")

    hub = types.SimpleNamespace(snapshot_download=snapshot_download)
    monkeypatch.setitem(sys.modules, "huggingface_hub", hub)
    with pytest.raises(AssetsError, match=r"no route to host.*check the connection"):
        installation.download_authentic(tmp_path / "cache")
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(DependencyError, match="pip install huggingface_hub"):
        installation.download_authentic(tmp_path / "cache")


def test_the_environment_may_be_anywhere(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv(HOME_VARIABLE, str(tmp_path / "mine"))
    assert default_home() == tmp_path / "mine"
    monkeypatch.delenv(HOME_VARIABLE)
    assert default_home().name in (".venv-libero", "libero-env")


def test_a_child_gets_its_own_variables_and_not_those_of_this_python(
    environment: LiberoEnvironment, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", "/elsewhere")
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    variables = environment.variables(render=False)
    assert "PYTHONPATH" not in variables
    assert variables["OMP_NUM_THREADS"] == "3"
    options = Options("libero_goal", "/assets", 256, render=True, plain=False)
    command = environment.command(options.to_json())
    assert command[:2] == [str(environment.python), "-I"]
    assert Options.from_json(command[-1]) == options


@pytest.mark.parametrize(
    ("task", "instruction"),
    [
        (
            "pick_up_the_milk_and_place_it_in_the_basket",
            "pick up the milk and place it in the basket",
        ),
        ("KITCHEN_SCENE8_put_both_moka_pots_on_the_stove", "put both moka pots on the stove"),
        ("LIVING_ROOM_SCENE10_stack_the_bowls", "stack the bowls"),
    ],
)
def test_instructions_are_the_names_without_their_scene(task: str, instruction: str) -> None:
    assert libero_api.instruction_of(task) == instruction


# ---------------------------------------------------------------- initial states


def write_states(path: Path, content: object) -> Path:
    """As ``torch.save`` writes what is not a tensor."""
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("archive/data.pkl", pickle.dumps(content, protocol=2))
        archive.writestr("archive/version", "3")
    return path


def test_initial_states_are_read_without_torch(tmp_path: Path) -> None:
    states = np.random.default_rng(0).normal(size=(50, 92))
    path = write_states(tmp_path / "task.pruned_init", states)
    np.testing.assert_array_equal(read_init_states(path), states)


class Harmful:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.mkdir, ("harm-was-done",)


@pytest.mark.parametrize(
    "content", [Harmful(), [np.zeros((2, 2)), Harmful()], np.array([[Harmful()]], dtype=object)]
)
def test_initial_states_that_would_execute_something_are_refused(
    tmp_path: Path, content: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    path = write_states(tmp_path / "task.pruned_init", content)
    with pytest.raises(ValueError, match="refused to load"):
        read_init_states(path)
    assert not (tmp_path / "harm-was-done").exists()


@pytest.mark.parametrize("content", [np.zeros(3), np.zeros((2, 2), np.float32), {"states": 1}])
def test_initial_states_of_another_shape_are_refused(tmp_path: Path, content: object) -> None:
    path = write_states(tmp_path / "task.pruned_init", content)
    with pytest.raises(ValueError, match="array of float64"):
        read_init_states(path)


def test_a_file_that_torch_did_not_write_is_refused(tmp_path: Path) -> None:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("readme.txt", "hello")
    path = tmp_path / "task.pruned_init"
    path.write_bytes(buffer.getvalue())
    with pytest.raises(ValueError, match="not a file written by torch"):
        read_init_states(path)
