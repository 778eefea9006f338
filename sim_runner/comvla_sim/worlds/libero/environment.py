"""LIBERO's own Python environment: where it is, whether it is ready, how a child is started in it.

LIBERO's pins (mujoco 3.3.2, robosuite 1.4.0, NumPy 1) fight with those of the rest of ComVLA.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
from dataclasses import dataclass
from pathlib import Path

from comvla.errors import DependencyError
from comvla_sim.worlds.rendering import find_gl_backend

HOME_VARIABLE = "COMVLA_LIBERO_ENV"
"""Environment variable that names the folder of LIBERO's environment."""

SETUP_COMMAND = "comvla-sim libero setup"

CONSTRAINTS = Path(__file__).with_name("constraints-libero.txt")
CHILD = Path(__file__).with_name("child") / "__main__.py"

_STAMP = "comvla/ready.json"

# What a child needs of its parent's environment, beside what is set for it below. LD_LIBRARY_PATH
# and MESA_* decide which OpenGL library there is.
_INHERITED = ("PATH", "HOME", "TMPDIR", "LANG", "LC_ALL", "LD_LIBRARY_PATH", "USER")
_INHERITED_PREFIXES = ("MESA_", "GALLIUM_", "LP_", "EGL_", "CUDA_", "NVIDIA_", "COVERAGE_")


def default_home() -> Path:
    """Where the environment is: ``COMVLA_LIBERO_ENV``, else ``.venv-libero`` in a working copy of
    the repository, else a folder of the user's cache."""
    chosen = os.environ.get(HOME_VARIABLE)
    if chosen:
        return Path(chosen).expanduser().absolute()
    repository = Path(__file__).resolve().parents[4]
    if (repository / "pyproject.toml").is_file() and (repository / "sim_runner").is_dir():
        return repository / ".venv-libero"
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return cache / "comvla" / "libero-env"


@dataclass(frozen=True)
class LiberoEnvironment:
    """The environment in a folder, set up or not.

    Attributes:
        home: the virtual environment.
    """

    home: Path

    @property
    def python(self) -> Path:
        """Its interpreter."""
        return self.home / "bin" / "python"

    @property
    def unpacked_assets(self) -> Path:
        """Where packs of assets are unpacked."""
        return self.home / "comvla" / "assets"

    @property
    def config_folder(self) -> Path:
        """``LIBERO_CONFIG_PATH``: without a file in it, LIBERO would prompt on stdin."""
        return self.home / "comvla" / "config"

    def package(self) -> Path:
        """LIBERO's package, with task definitions and initial states.

        Raises:
            DependencyError: it is not installed.
        """
        for path in sorted(self.home.glob("lib/python3.*/site-packages/libero/libero")):
            return path
        raise self._not_ready("is not set up")

    def stamp(self) -> Path:
        """The file that says what was installed."""
        return self.home / _STAMP

    def write_stamp(self) -> None:
        """Notes that the environment is complete."""
        self.stamp().parent.mkdir(parents=True, exist_ok=True)
        self.stamp().write_text(json.dumps({"constraints_sha256": _constraints_sha256()}) + "\n")

    def is_ready(self) -> bool:
        """Whether the environment is complete and made from the present pins."""
        try:
            stamp = json.loads(self.stamp().read_text())
        except (OSError, ValueError):
            return False
        return self.python.exists() and stamp == {"constraints_sha256": _constraints_sha256()}

    def require(self) -> None:
        """Refuses an environment that is missing, incomplete or made from other pins.

        Raises:
            DependencyError: names the command that sets it up.
        """
        if not sys.platform.startswith("linux"):
            raise DependencyError(f"the LIBERO world runs on Linux, this is {sys.platform}")
        if not self.is_ready():
            stale = self.stamp().exists()
            raise self._not_ready("was made from other pins" if stale else "is not set up")

    def _not_ready(self, what: str) -> DependencyError:
        return DependencyError(
            f"LIBERO's environment in {self.home} {what}: run `{SETUP_COMMAND}` "
            f"(or `make libero`), or name another folder in {HOME_VARIABLE}"
        )

    def write_config(self, assets: Path) -> None:
        """Writes LIBERO's ``config.yaml``, which would otherwise be asked for on stdin."""
        package = self.package()
        paths = {
            "benchmark_root": package,
            "bddl_files": package / "bddl_files",
            "init_states": package / "init_files",
            "datasets": self.home / "comvla" / "datasets",
            "assets": assets,
        }
        self.config_folder.mkdir(parents=True, exist_ok=True)
        # JSON is YAML, and quoting is its least surprising part.
        text = "".join(f"{key}: {json.dumps(str(path))}\n" for key, path in paths.items())
        (self.config_folder / "config.yaml").write_text(text)

    def command(self, options_json: str) -> list[str]:
        """The command line of a child."""
        # -I: neither PYTHONPATH nor the current folder may bring other versions in.
        return [str(self.python), "-I", str(CHILD), options_json]

    def variables(self, *, render: bool) -> dict[str, str]:
        """The environment variables of a child.

        Raises:
            DependencyError: pictures are wanted and there is no OpenGL library.
        """
        inherited = {
            name: value
            for name, value in os.environ.items()
            if name in _INHERITED or name.startswith(_INHERITED_PREFIXES)
        }
        threads = os.environ.get("OMP_NUM_THREADS", "1")
        return {
            **inherited,
            "LIBERO_CONFIG_PATH": str(self.config_folder),
            # robosuite wants an OpenGL library even where nothing is drawn; GLX needs none installed.
            "MUJOCO_GL": find_gl_backend() if render else "glx",
            "OMP_NUM_THREADS": threads,
            "OPENBLAS_NUM_THREADS": threads,
            "HF_HUB_OFFLINE": "1",  # nothing may be downloaded behind anybody's back
            "MPLBACKEND": "agg",
        }


def _constraints_sha256() -> str:
    return hashlib.sha256(CONSTRAINTS.read_bytes()).hexdigest()
