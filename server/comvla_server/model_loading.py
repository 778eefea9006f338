"""From the name of a checkpoint to an engine, and what is known of it before gigabytes are read."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from comvla.model_info import ModelInfo
from comvla_server.settings import ServerSettings

if TYPE_CHECKING:  # torch takes seconds to import: --help does without it
    from comvla_server.engine import Engine
    from comvla_vla.config import ModelConfig


@dataclass(frozen=True)
class Candidate:
    """A checkpoint that was opened, and whose weights are still on disk.

    Attributes:
        source: what it was asked for by.
        info: description of the model.
        needed_bytes: memory that it takes beside whatever is loaded already, weights and work.
        available_bytes: memory that can be had where it would lie; None where nobody tells.
        edge_identity: digest over its edge half; None where the checkpoint does not say.
    """

    source: str
    info: ModelInfo
    needed_bytes: int
    available_bytes: int | None
    edge_identity: str | None = None


class Loader(Protocol):
    """Finds and loads models for a server that runs."""

    def inspect(self, source: str) -> Candidate:
        """What a checkpoint is, without loading it; CheckpointError where it is no good."""

    def load(self, source: str) -> Engine:
        """The model, ready to be warmed up; CheckpointError where it is no good."""


class CheckpointLoader:
    """Loads checkpoints as the settings say: device, number format, vision.

    Args:
        settings: of the server.
    """

    def __init__(self, settings: ServerSettings) -> None:
        self._settings = settings

    def load(self, source: str) -> Engine:
        """See :func:`load_engine`."""
        return load_engine(self._settings, source)

    def inspect(self, source: str) -> Candidate:
        """What a checkpoint is, without loading it.

        Raises:
            CheckpointError: missing, damaged, foreign or incomplete.
        """
        import torch

        from comvla_vla.checkpoints import model_info, open_checkpoint
        from comvla_vla.checkpoints.seeing import edge_identity

        settings = self._settings
        checkpoint = open_checkpoint(source, "cloud")
        statistics = checkpoint.chosen_statistics(settings.statistics_key)
        vision = _wants_vision(settings, source)
        weights = _weights(checkpoint.config, vision)
        return Candidate(
            source=source,
            info=model_info(checkpoint.config, checkpoint.identity(), statistics),
            needed_bytes=_needed(weights * getattr(torch, settings.dtype).itemsize),
            available_bytes=_available(settings.device),
            edge_identity=edge_identity(checkpoint),
        )


def load_engine(settings: ServerSettings, source: str | None = None) -> Engine:
    """The cloud half of a checkpoint, ready to run, with the vision half where that is wanted.

    Args:
        settings: how to run it.
        source: the checkpoint; the one that the settings name first where None.

    Raises:
        CheckpointError: missing, damaged, foreign, incomplete, or too large for this machine's memory.
    """
    import torch

    from comvla_server.engine import Engine
    from comvla_server.vision import load_vision
    from comvla_vla import CloudOptions, FastV, load_cloud

    if source is None:
        source = next(iter(settings.models.values()))
    if settings.threads is not None:
        torch.set_num_threads(settings.threads)
    options = CloudOptions(
        fastv=None if settings.fastv is None else FastV(*settings.fastv),
        compact_positions=settings.compact_positions,
        compile=settings.compile,
    )
    cloud = load_cloud(
        source,
        device=settings.device,
        dtype=getattr(torch, settings.dtype),
        statistics_key=settings.statistics_key,
        options=options,
        verify=settings.verify,
    )
    edge_identity = _edge_identity(source)
    if not _wants_vision(settings, source):
        return Engine(cloud, edge_identity=edge_identity)
    vision = load_vision(source, cloud, settings.device, statistics_key=settings.statistics_key)
    return Engine(cloud, vision, edge_identity)


def _edge_identity(source: str) -> str | None:
    """Asked when a model is loaded: later its folder may hold another."""
    from comvla_vla.checkpoints import open_checkpoint
    from comvla_vla.checkpoints.seeing import edge_identity

    return edge_identity(open_checkpoint(source, "cloud"))


def _wants_vision(settings: ServerSettings, source: str) -> bool:
    from comvla_server.vision import holds_whole

    return settings.vision == "on" or (settings.vision == "auto" and holds_whole(source))


def _weights(config: ModelConfig, vision: bool) -> int:
    """Numbers in the weights. Projector and text embedding stand in both halves and are held once."""
    from math import prod

    from comvla_vla.checkpoints.accounting import half_shapes
    from comvla_vla.checkpoints.opened import SHARED_PREFIXES

    shapes = half_shapes("cloud", config)
    if vision:
        edge = half_shapes("edge", config)
        shapes |= {n: s for n, s in edge.items() if not n.startswith(SHARED_PREFIXES)}
    return sum(prod(shape) for shape in shapes.values())


def _needed(weight_bytes: int) -> int:
    from comvla_vla.checkpoints.memory import WORKING_BYTES

    return weight_bytes + min(weight_bytes, WORKING_BYTES)


def _available(device: str) -> int | None:
    import torch

    from comvla_vla.checkpoints.memory import available_bytes

    kind = torch.device(device).type
    if kind == "cuda":
        return int(torch.cuda.mem_get_info(device)[0])
    return available_bytes() if kind == "cpu" else None
