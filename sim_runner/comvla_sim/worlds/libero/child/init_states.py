"""Reads LIBERO's fixed initial states without torch and without executing anything."""

from __future__ import annotations

import io
import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

# What an array written by `torch.save` needs, and nothing that could do harm. NumPy moved its
# reconstruction function, so it is named by its value, not by its place.
_RECONSTRUCT: Any = np.empty(0).__reduce__()[0]


def _latin1(text: str, encoding: str) -> bytes:
    """How the second protocol of pickle writes bytes."""
    if encoding != "latin1":
        raise ValueError(f"refused the encoding {encoding!r}")
    return text.encode("latin1")


_PERMITTED = {
    ("numpy.core.multiarray", "_reconstruct"): _RECONSTRUCT,
    ("numpy._core.multiarray", "_reconstruct"): _RECONSTRUCT,
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
    ("_codecs", "encode"): _latin1,
}


class _ArrayReader(pickle.Unpickler):
    """Rebuilds NumPy arrays and refuses everything else."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _PERMITTED:
            raise ValueError(f"refused to load {module}.{name}: expected a plain NumPy array")
        return _PERMITTED[module, name]


def read_init_states(path: Path) -> np.ndarray[Any, np.dtype[np.float64]]:
    """The initial states of a task.

    Args:
        path: a ``.pruned_init`` file of LIBERO.

    Returns:
        (states, n) float64.

    Raises:
        ValueError: the file holds anything but one array.
    """
    with zipfile.ZipFile(path) as archive:
        names = [name for name in archive.namelist() if name.endswith("/data.pkl")]
        if len(names) != 1:
            raise ValueError(f"{path} is not a file written by torch.save")
        states = _ArrayReader(io.BytesIO(archive.read(names[0]))).load()
    if not isinstance(states, np.ndarray) or states.ndim != 2 or states.dtype != np.float64:
        raise ValueError(f"{path} holds no (states, n) array of float64")
    return states
