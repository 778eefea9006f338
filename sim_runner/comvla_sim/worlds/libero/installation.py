"""Makes LIBERO's environment: interpreter, exact packages, an OpenGL library, assets."""

from __future__ import annotations

import contextlib
import importlib
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from comvla.errors import DependencyError
from comvla_sim.worlds.libero.assets import (
    AUTHENTIC,
    HUB_REPOSITORY,
    Assets,
    find_assets,
    hub_cache,
    unpack,
)
from comvla_sim.worlds.libero.environment import CONSTRAINTS, LiberoEnvironment
from comvla_sim.worlds.libero.errors import AssetsError
from comvla_sim.worlds.rendering import find_gl_backend

PYTHONS = ((3, 10), (3, 12))
"""Oldest and newest Python that the pinned packages run on."""

Say = Callable[[str], None]


def set_up(
    environment: LiberoEnvironment,
    *,
    python: str | None = None,
    packs: Path | None = None,
    download: bool = False,
    say: Say = print,
) -> Assets:
    """Makes or completes the environment. Run again, it does only what is missing.

    Args:
        environment: where.
        python: the interpreter to make it with; None looks for one.
        packs: folder with packs of assets to unpack.
        download: fetch the authentic assets from the hub.
        say: told what is going on.

    Returns:
        The assets that worlds will use.

    Raises:
        DependencyError: no suitable Python, or packages that cannot be installed.
        AssetsError: there are no assets, or they cannot be fetched or unpacked.
    """
    if environment.is_ready():
        say(f"{environment.home} is up to date")
    else:
        _install(environment, python, say)
    _ensure_gl(say)
    if download:
        say(f"downloading {HUB_REPOSITORY} into {hub_cache()}")
        download_authentic(hub_cache())
    if packs is not None:
        names = unpack(packs, environment.unpacked_assets)
        say(f"unpacked {', '.join(names)}")
    assets = find_assets(environment.package(), environment.unpacked_assets)
    environment.write_config(assets.folder)
    if assets.label != AUTHENTIC:
        say("these are stand-in assets: never compare success rates with published ones")
    return assets


def find_python(named: str | None) -> str:
    """An interpreter that the pinned packages run on.

    Args:
        named: the one to use; None prefers the one that is running.

    Raises:
        DependencyError: it is too old or too new, or there is none.
    """
    low, high = PYTHONS
    newest_first = [f"python{low[0]}.{minor}" for minor in range(high[1], low[1] - 1, -1)]
    candidates = [named] if named else [sys.executable, *newest_first]
    for candidate in candidates:
        path = shutil.which(candidate)
        version = _version_of(path) if path else None
        if path and version and low <= version <= high:
            return path
    wanted = f"{low[0]}.{low[1]} to {high[0]}.{high[1]}"
    raise DependencyError(
        f"LIBERO's packages need Python {wanted}, found none in {', '.join(candidates)}: install "
        "one and name it, `comvla-sim libero setup --python python3.11`"
    )


def _version_of(python: str) -> tuple[int, int] | None:
    code = "import sys; print(*sys.version_info[:2])"
    answer = subprocess.run([python, "-c", code], capture_output=True, text=True, check=False)
    with contextlib.suppress(ValueError):
        major, minor = (int(part) for part in answer.stdout.split())
        return major, minor
    return None  # a shim without anything behind it


def _install(environment: LiberoEnvironment, named: str | None, say: Say) -> None:
    python = find_python(named)
    if not environment.python.exists():
        say(f"creating {environment.home} with {python}")
        _run([python, "-m", "venv", str(environment.home)], "make a virtual environment")
    environment.stamp().unlink(missing_ok=True)  # until this is complete, it is not
    say("installing LIBERO's packages (minutes, about 1.3 GB)")
    pip = [str(environment.python), "-m", "pip", "install", "--disable-pip-version-check"]
    # The list is closed: dependencies that it leaves out are left out on purpose.
    _run([*pip, "--quiet", "--no-deps", "--requirement", str(CONSTRAINTS)], "install packages")
    environment.write_stamp()


def _run(command: Sequence[str], purpose: str) -> None:
    answer = subprocess.run(command, stderr=subprocess.PIPE, text=True, check=False)
    if answer.returncode:
        raise DependencyError(
            f"cannot {purpose}: `{' '.join(command)}` failed:\n{answer.stderr.strip()[-2000:]}"
        )


def _ensure_gl(say: Say) -> None:
    """Installs an OpenGL library where that is possible without asking anybody."""
    try:
        find_gl_backend()
        return
    except DependencyError as error:
        missing = error
    apt = shutil.which("apt-get")
    if apt is None or os.geteuid() != 0:
        say(f"pictures cannot be drawn yet: {missing}")
        return
    say("installing the system package libosmesa6")
    _run([apt, "-qq", "update"], "update the list of system packages")
    _run([apt, "-qq", "install", "-y", "--no-install-recommends", "libosmesa6"], "install OSMesa")


def download_authentic(folder: Path) -> None:
    """Fetches the benchmark's own assets. Only ever called because somebody asked for it.

    Raises:
        DependencyError: huggingface_hub is not installed.
        AssetsError: the hub cannot be reached, or does not have them.
    """
    try:
        hub: Any = importlib.import_module("huggingface_hub")
    except ImportError as error:
        raise DependencyError(
            "downloading assets needs huggingface_hub: `pip install huggingface_hub`"
        ) from error
    try:
        hub.snapshot_download(HUB_REPOSITORY, repo_type="dataset", local_dir=str(folder))
    except Exception as error:  # requests', httpx' and its own: it promises none
        raise AssetsError(
            f"cannot download {HUB_REPOSITORY} ({type(error).__name__}: {error}): check the "
            f"connection, or put the assets into {folder} by other means"
        ) from error
