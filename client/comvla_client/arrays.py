"""NumPy in, NumPy out; torch in, torch out, without ever importing torch."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    import torch
    from typing_extensions import TypeIs

NumpyArray: TypeAlias = npt.NDArray[Any]
Array: TypeAlias = "NumpyArray | torch.Tensor"
AnyArray = TypeVar("AnyArray", NumpyArray, "torch.Tensor")


def is_torch(value: object) -> TypeIs[torch.Tensor]:
    """Whether ``value`` is a torch tensor. Where nobody imported torch, nothing can be one."""
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(value, torch.Tensor)


def to_numpy(value: Array, dtype: npt.DTypeLike) -> NumpyArray:
    """Copies a tensor from wherever it lives, or passes an array through, as ``dtype``."""
    if is_torch(value):
        value = value.detach()
        # NumPy has no bfloat16, and half precision gains nothing once it leaves the accelerator.
        if value.dtype.is_floating_point and value.dtype.itemsize < 4:
            value = value.float()
        value = value.cpu().numpy()
    return np.asarray(value, dtype=dtype)
