"""Everything that is taken from LIBERO and robosuite, in one place.

They carry no types, and importing them takes seconds and opens an OpenGL library, so it happens in
functions. torch is never imported: LIBERO only needs it to read files that
:mod:`.init_states` reads without it.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import platform
import re
from pathlib import Path
from typing import Any

_SCENE_PREFIX = re.compile(r"^[A-Z_]+_SCENE\d+_")
_VERSIONS = ("hf-libero", "robosuite", "mujoco", "bddl")


def use_assets(folder: str) -> None:
    """Makes LIBERO take its meshes from ``folder``.

    LIBERO ignores the ``assets`` entry of its configuration file and downloads what it misses. It
    looks at this variable before both.
    """
    package: Any = importlib.import_module("libero.libero")
    package._assets_path_cache = folder


def package_folder() -> Path:
    """LIBERO's folder with ``bddl_files`` and ``init_files``."""
    spec = importlib.util.find_spec("libero.libero")
    assert spec is not None
    assert spec.origin is not None
    return Path(spec.origin).parent


def task_names(suite: str) -> list[str]:
    """Names of a suite's tasks, in LIBERO's order.

    The table is loaded from its file: importing the package around it would import torch.
    """
    path = package_folder() / "benchmark" / "libero_suite_task_map.py"
    spec = importlib.util.spec_from_file_location("libero_suite_task_map", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return list(module.libero_task_map[suite])


def instruction_of(task: str) -> str:
    """The sentence that goes with a task, which is its name without the scene."""
    return _SCENE_PREFIX.sub("", task).replace("_", " ")


def make_environment(bddl_file: str, *, offscreen: bool) -> Any:
    """LIBERO's environment of a task, without camera observations.

    Args:
        bddl_file: the task's definition.
        offscreen: open an OpenGL context.
    """
    wrapper = importlib.import_module("libero.libero.envs.env_wrapper")
    return wrapper.ControlEnv(
        bddl_file_name=bddl_file,
        has_offscreen_renderer=offscreen,
        use_camera_obs=False,
        hard_reset=False,
    )


def observable(name: str, on_sample: Any, rate_hz: float) -> Any:
    """A robosuite observable that calls ``on_sample()`` whenever robosuite takes pictures."""
    observables = importlib.import_module("robosuite.utils.observables")

    @observables.sensor(modality="image")  # type: ignore[untyped-decorator]
    def sample(cache: Any) -> float:
        del cache
        on_sample()
        return 0.0

    return observables.Observable(name=name, sensor=sample, sampling_rate=rate_hz, active=False)


def versions() -> dict[str, str]:
    """Versions of what decides how the simulation behaves."""
    found = {name: importlib.metadata.version(name) for name in _VERSIONS}
    found["simulator-numpy"] = importlib.metadata.version("numpy")
    return {**found, "simulator-python": platform.python_version()}


def load() -> None:
    """Imports what takes seconds, so that it happens at the start and not in the first episode."""
    importlib.import_module("libero.libero.envs.env_wrapper")
