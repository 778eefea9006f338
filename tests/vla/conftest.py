"""Halves of the reference checkpoints, split once per session."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest
import torch
from reference_data import checkpoint

from comvla_vla import CloudModel, EdgeModel, load_cloud, load_edge, split_checkpoint


class Reference(NamedTuple):
    """One golden checkpoint as a user would have it."""

    published: Path
    edge: EdgeModel
    cloud: CloudModel


@pytest.fixture(scope="session")
def reference(tmp_path_factory) -> Callable[..., Reference]:
    """``reference("oft", "film")``: the checkpoint with those parts, split, and its halves loaded."""
    made: dict[tuple[object, ...], Reference] = {}

    def make(*parts: str, dtype: torch.dtype = torch.float32) -> Reference:
        key = (*parts, dtype)
        if key not in made:
            folder = tmp_path_factory.mktemp("_".join(parts))
            source = checkpoint(folder / "published", *parts)
            split_checkpoint(source, folder / "split")
            made[key] = Reference(
                source,
                load_edge(folder / "split" / "edge", dtype=dtype),
                load_cloud(folder / "split" / "cloud", dtype=dtype),
            )
        return made[key]

    return make
