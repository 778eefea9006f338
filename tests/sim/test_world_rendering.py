"""An OpenGL library is found without help, only when needed, and its absence is explained."""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys

import pytest

pytest.importorskip("metaworld")

from comvla.errors import DependencyError
from comvla_sim.worlds import rendering

pytestmark = [
    pytest.mark.simulator,
    # pytest undoes the filter that a world sets for its experts' remark about clipping.
    pytest.mark.filterwarnings("ignore:Constant"),
]


def run(code: str, **environment: str) -> str:
    """The output of a fresh interpreter that does not inherit MUJOCO_GL."""
    env = {k: v for k, v in os.environ.items() if k not in ("MUJOCO_GL", "PYOPENGL_PLATFORM")}
    command = [sys.executable, "-c", code]
    done = subprocess.run(
        command, capture_output=True, text=True, env=env | environment, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_importing_the_package_probes_and_imports_nothing() -> None:
    code = (
        "import os, sys, comvla_sim.worlds\n"
        "print('mujoco' in sys.modules, 'gymnasium' in sys.modules, 'MUJOCO_GL' in os.environ)"
    )
    assert run(code) == "False False False"


def test_the_users_choice_is_honoured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "EGL")
    assert rendering.find_gl_backend() == "egl"


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="other systems bring their own")
def test_the_first_library_that_opens_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    def only_egl(name: str) -> None:
        if "EGL" not in name:
            raise OSError(name)

    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(ctypes, "CDLL", lambda name: None)
    assert rendering.find_gl_backend() == "osmesa"
    monkeypatch.setattr(ctypes, "CDLL", only_egl)
    assert rendering.find_gl_backend() == "egl"


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="other systems bring their own")
def test_without_a_library_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    def nothing(name: str) -> None:
        raise OSError(name)

    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(ctypes, "CDLL", nothing)
    with pytest.raises(DependencyError, match="apt-get install libosmesa6"):
        rendering.find_gl_backend()


def test_a_world_that_draws_nothing_needs_no_library() -> None:
    code = (
        "from comvla_sim.worlds import rendering, make\n"
        "rendering._LINUX_LIBRARIES = ()\n"
        "world = make('tabletop', render=False)\n"
        "print(world.reset(seed=0)[1]['success'])"
    )
    assert run(code) == "False"


def test_a_library_that_mujoco_refuses_is_explained() -> None:
    code = (
        "from comvla.errors import DependencyError\n"
        "from comvla_sim.worlds import make\n"
        "try:\n"
        "    make('tabletop').reset(seed=0)\n"
        "except DependencyError as error:\n"
        "    print(error)"
    )
    assert "render=False" in run(code, MUJOCO_GL="disable")
    assert "MUJOCO_GL" in run(code, MUJOCO_GL="papyrus")


def test_a_closed_renderer_is_made_anew_by_its_world() -> None:
    from comvla_sim.worlds import make

    world = make("tabletop", image_size=32)
    before = world.reset(seed=0)[0]["images"]
    world.close()
    world.close()
    assert (world.observe()["images"] == before).all()
    world.close()
