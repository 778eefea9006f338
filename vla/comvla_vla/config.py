"""Sizes and switches of a split Vision-Language-Action policy.

One implementation serves every size; what differs between the published OpenVLA-OFT layout and the small
shipped policy is written down here and nowhere else. Symbols follow the paper: N ``num_tokens``, D ``token_dim``.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from typing import Any, Literal

from comvla.errors import CheckpointError
from comvla_vla.config_checks import check_fit, check_values


@dataclass(frozen=True)
class TowerConfig:
    """One vision tower: pixels of one view to a (rows * columns, dim) grid of features.

    Attributes:
        kind: ``"vit"`` (as published: DINOv2, SigLIP) or ``"conv"`` (a small ConvNeXt-type tower).
        dim: width of the features it contributes to a token.
        image_size: pixels per side. patch_size: pixels per token and side.
        mean, std: per-channel normalisation of pixels in [0, 1].
        depth: blocks in the checkpoint (ViT). The last one is never run: features are those of the
            second-to-last block, as OpenVLA takes them.
        class_token, register_tokens: prefix tokens, dropped from the output.
        layer_scale: whether each residual branch carries a learned scale (DINOv2).
        norm_eps: epsilon of the LayerNorms.
        stem_dim, kernels: widths of the first stage and depthwise kernels of the second one (conv).
        film_dim: width of the language vector that scales and shifts every block (FiLM), 0 for none.
    """

    kind: Literal["vit", "conv"]
    dim: int
    image_size: int
    patch_size: int
    mean: tuple[float, float, float]
    std: tuple[float, float, float]
    depth: int = 0
    heads: int = 0
    mlp_dim: int = 0
    class_token: bool = False
    register_tokens: int = 0
    layer_scale: bool = False
    norm_eps: float = 1e-6
    stem_dim: int = 0
    kernels: tuple[int, ...] = ()
    film_dim: int = 0

    @property
    def side(self) -> int:
        """Tokens per side of the square grid."""
        return self.image_size // self.patch_size

    @property
    def prefix_tokens(self) -> int:
        """Tokens in front of the patches (class and registers)."""
        return int(self.class_token) + self.register_tokens


@dataclass(frozen=True)
class ProjectorConfig:
    """From a fused vision feature (D) to the backbone's width (d).

    ``"fused_mlp"`` is OpenVLA's fc1-GELU-fc2-GELU-fc3 with a 4 D hidden layer, ``"linear"`` a single layer.
    ``norm`` adds a LayerNorm, ``positions`` two-dimensional sines and a view embedding (both off as published).
    """

    kind: Literal["fused_mlp", "linear"] = "fused_mlp"
    norm: bool = False
    positions: Literal["none", "sine2d"] = "none"
    sine_amplitude: float = 1.4


@dataclass(frozen=True)
class BackboneConfig:
    """A Llama-type transformer, bidirectional here. Defaults are Llama-2-7B's with OpenVLA's epsilon."""

    hidden: int = 4096
    intermediate: int = 11008
    layers: int = 32
    heads: int = 32
    vocab: int = 32064
    rms_eps: float = 1e-6
    rope_theta: float = 10_000.0
    max_positions: int = 2048

    @property
    def head_dim(self) -> int:
        """Width of one attention head."""
        return self.hidden // self.heads


@dataclass(frozen=True)
class ActionConfig:
    """The chunk of actions and the head that reads it off.

    Attributes:
        horizon: H actions. action_dim: A. proprio_dim: P, 0 for none.
        head_hidden: width inside the head (OpenVLA-OFT: the backbone's). head_blocks: residual blocks.
        learned_placeholders: trained vectors instead of the zeros of the published layout.
        first_slot: offset of the hidden states that the head reads, relative to the first action placeholder.
            OpenVLA-OFT is trained and run from one position before it (-1), VLA-ADP runs from it (0), LightVLA's
            published inference from one after it (1).
        head: ``"l1"`` regresses the chunk in one pass, ``"diffusion"`` denoises it (DDIM).
        diffusion_train_steps, diffusion_steps: noise levels in training, and passes at inference.
    """

    horizon: int
    action_dim: int
    proprio_dim: int
    head_hidden: int
    head_blocks: int = 2
    learned_placeholders: bool = False
    first_slot: int = -1
    head: Literal["l1", "diffusion"] = "l1"
    diffusion_train_steps: int = 50
    diffusion_steps: int = 50

    @property
    def slots(self) -> int:
        """Action placeholders in the sequence: H * A."""
        return self.horizon * self.action_dim


@dataclass(frozen=True)
class PromptConfig:
    """How an instruction becomes token ids.

    Attributes:
        template: with ``{instruction}``. lowercase: whether the instruction is lowered first.
        trailing_id: appended when the tokenizer does not end with it (OpenVLA: 29871), or None.
        bos_id, stop_id: begin-of-sequence and end ids.
        queries_per_token: language queries per word. 1 takes the text embedding itself (paper);
            more read a table of their own.
        unknown_words: ``"error"`` refuses words outside a closed vocabulary.
    """

    template: str = "In: What action should the robot take to {instruction}?\nOut:"
    lowercase: bool = True
    trailing_id: int | None = 29871
    bos_id: int = 1
    stop_id: int = 2
    queries_per_token: int = 1
    unknown_words: Literal["error", "allow"] = "allow"
    max_tokens: int = 256


@dataclass(frozen=True)
class ModelConfig:
    """Everything that fixes the shapes and the arithmetic of one policy.

    Attributes:
        preprocess: ``"exact"`` takes pictures of the towers' size as they are, ``"openvla"`` repeats what
            OpenVLA-OFT's evaluation does to camera pictures of any size.
        edge_pruners: other pruners whose weights the edge half carries: ``"lightvla"``, ``"vla_adp"``.
    """

    name: str
    views: int
    towers: tuple[TowerConfig, ...]
    projector: ProjectorConfig
    backbone: BackboneConfig
    action: ActionConfig
    prompt: PromptConfig
    preprocess: Literal["exact", "openvla"] = "exact"
    control_period_s: float = 0.05
    edge_pruners: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_values(self)
        check_fit(self)

    @property
    def film(self) -> bool:
        """Whether the towers see the instruction."""
        return any(t.film_dim for t in self.towers)

    @property
    def token_dim(self) -> int:
        """D: width of a transmitted token, the towers' features side by side."""
        return sum(t.dim for t in self.towers)

    @property
    def grid(self) -> tuple[int, int, int]:
        """(views, rows, columns) of the tokens, row-major."""
        side = self.towers[0].side
        return self.views, side, side

    @property
    def num_tokens(self) -> int:
        """N: visual tokens of an unpruned observation."""
        views, rows, columns = self.grid
        return views * rows * columns

    def to_dict(self) -> dict[str, Any]:
        """A JSON-ready mapping; :meth:`from_dict` is its inverse."""
        return asdict(self)

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> ModelConfig:
        """Builds a configuration from :meth:`to_dict`'s mapping.

        Raises:
            CheckpointError: unknown or missing keys, values out of range or that contradict one another.
        """
        try:
            return cls(
                name=data["name"],
                views=data["views"],
                towers=tuple(_build(TowerConfig, t) for t in data["towers"]),
                projector=_build(ProjectorConfig, data["projector"]),
                backbone=_build(BackboneConfig, data["backbone"]),
                action=_build(ActionConfig, data["action"]),
                prompt=_build(PromptConfig, data["prompt"]),
                preprocess=data.get("preprocess", "exact"),
                control_period_s=data.get("control_period_s", 0.05),
                edge_pruners=tuple(data.get("edge_pruners", ())),
            )
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise CheckpointError(
                f"the model configuration is not one that this version reads: {error}; "
                "re-export the checkpoint with this version of comvla"
            ) from error


def _build(kind: type[Any], data: dict[str, Any]) -> Any:
    """Dataclass from a mapping; lists become tuples; unknown keys are an error."""
    unknown = set(data) - {f.name for f in fields(kind)}
    if unknown:
        raise ValueError(f"{kind.__name__} does not know {sorted(unknown)}")
    return kind(**{k: tuple(v) if isinstance(v, list) else v for k, v in data.items()})
