"""Values of a configuration that came from somewhere else: types, ranges, and what must fit together.

Sizes are bounded so that a hostile or damaged file is refused before anything is built from it. The bounds leave
an order of magnitude beyond the largest policies of this family.
"""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from string import Formatter
from types import UnionType
from typing import TYPE_CHECKING, Any, Literal, Union, get_args, get_origin, get_type_hints

from comvla.errors import CheckpointError

if TYPE_CHECKING:
    from comvla_vla.config import ModelConfig, TowerConfig

_WIDTH, _DEPTH, _COUNT = 65_536, 512, 65_535

BOUNDS: dict[str, tuple[float, float]] = {
    "views": (1, 64),
    "control_period_s": (1e-6, 3600),
    # towers
    "dim": (1, _WIDTH),
    "image_size": (1, 8192),
    "patch_size": (1, 8192),
    "mean": (-1e3, 1e3),
    "std": (1e-6, 1e3),
    "depth": (0, _DEPTH),
    "heads": (0, 4096),
    "mlp_dim": (0, 16 * _WIDTH),
    "register_tokens": (0, 1024),
    "norm_eps": (1e-12, 1),
    "stem_dim": (0, _WIDTH),
    "kernels": (1, 63),
    "film_dim": (0, _WIDTH),
    # projector
    "sine_amplitude": (-1e3, 1e3),
    # backbone
    "hidden": (2, _WIDTH),
    "intermediate": (1, 16 * _WIDTH),
    "layers": (1, _DEPTH),
    "vocab": (3, 2**22),
    "rms_eps": (1e-12, 1),
    "rope_theta": (1, 1e12),
    "max_positions": (1, 2**20),
    # actions
    "horizon": (1, 4096),
    "action_dim": (1, 1024),
    "proprio_dim": (0, _COUNT),
    "head_hidden": (1, _WIDTH),
    "head_blocks": (0, 64),
    "first_slot": (-1, 1),
    "diffusion_train_steps": (1, 100_000),
    "diffusion_steps": (1, 100_000),
    # prompt
    "trailing_id": (0, 2**22),
    "bos_id": (0, 2**22),
    "stop_id": (0, 2**22),
    "queries_per_token": (1, 64),
    "max_tokens": (1, _COUNT),
}
"""Least and largest value of every number in a configuration, by its name."""

_LONGEST_TEXT = 2000
_LONGEST_LIST = 64


def check_values(config: object, where: str = "") -> None:
    """Types and ranges of all values, dataclass by dataclass.

    Raises:
        CheckpointError: naming the value and what it should be.
    """
    hints = get_type_hints(type(config))
    for field in fields(config):  # type: ignore[arg-type]
        _check(f"{where}{field.name}", field.name, getattr(config, field.name), hints[field.name])


def _check(path: str, name: str, value: Any, hint: Any) -> None:
    origin = get_origin(hint)
    if origin is Literal:
        _require(path, value, value in get_args(hint), f"one of {list(get_args(hint))}")
    elif origin in (Union, UnionType):  # a number or nothing
        if value is not None:
            _check(path, name, value, get_args(hint)[0])
    elif origin is tuple:
        _check_tuple(path, name, value, get_args(hint))
    elif is_dataclass(hint):
        assert isinstance(hint, type)
        _require(path, value, isinstance(value, hint), f"a {hint.__name__}")
        check_values(value, f"{path}.")
    elif hint is bool:
        _require(path, value, isinstance(value, bool), "true or false")
    elif hint is str:
        sound = isinstance(value, str) and 0 < len(value) <= _LONGEST_TEXT
        _require(path, value, sound, f"text of at most {_LONGEST_TEXT} characters")
    else:
        _check_number(path, value, hint, *BOUNDS[name])


def _check_tuple(path: str, name: str, value: Any, items: tuple[Any, ...]) -> None:
    any_length = len(items) == 2 and items[1] is Ellipsis
    fits = isinstance(value, tuple) and (
        len(value) <= _LONGEST_LIST if any_length else len(value) == len(items)
    )
    length = f"at most {_LONGEST_LIST}" if any_length else str(len(items))
    _require(path, value, fits, f"a list of {length} values")
    for index, item in enumerate(value):
        _check(f"{path}[{index}]", name, item, items[0 if any_length else index])


def _check_number(path: str, value: Any, kind: type, low: float, high: float) -> None:
    kinds = (int,) if kind is int else (int, float)
    sound = isinstance(value, kinds) and not isinstance(value, bool)
    words = "a whole number" if kind is int else "a number"
    # Infinities lie outside of any bounds, and nothing compares with NaN.
    _require(path, value, sound and low <= value <= high, f"{words} from {low:g} to {high:g}")


def _require(path: str, value: Any, sound: bool, wanted: str) -> None:
    if not sound:
        raise CheckpointError(
            f"the configuration has {path} = {value!r:.80}, expected {wanted}: the checkpoint is damaged, or of "
            "another kind than this version reads"
        )


def check_fit(config: ModelConfig) -> None:
    """What must hold between values that are each sound.

    Raises:
        CheckpointError: naming the contradiction.
    """
    backbone, action, prompt = config.backbone, config.action, config.prompt
    if not config.towers:
        raise CheckpointError(
            "a policy needs at least one vision tower, the configuration lists none"
        )
    sides = [(t.image_size, t.image_size // t.patch_size) for t in config.towers]
    _agree(len(config.towers) <= 2, f"this version runs one or two towers, got {len(sides)}")
    _agree(
        len(set(sides)) == 1,
        f"vision towers must share image size and grid, got (pixels, side) {sides}",
    )
    for tower in config.towers:
        _check_tower(tower, backbone.hidden)
    _agree(
        backbone.heads > 0 and backbone.hidden % (2 * backbone.heads) == 0,
        f"backbone width {backbone.hidden} does not split into {backbone.heads} heads of even width",
    )
    unknown = set(config.edge_pruners) - {"lightvla", "vla_adp"}
    _agree(not unknown, f"no such edge pruners: {sorted(unknown)}")
    _agree(
        config.projector.positions != "sine2d" or backbone.hidden % 4 == 0,
        f"2-D sine positions need a width divisible by 4, got {backbone.hidden}",
    )
    _agree(
        config.num_tokens <= _COUNT and config.token_dim <= _COUNT,
        f"{config.num_tokens} tokens of width {config.token_dim} are more than the link's format counts",
    )
    _agree(
        config.num_tokens + 3 + prompt.max_tokens + action.slots <= backbone.max_positions,
        f"the longest sequence exceeds the backbone's {backbone.max_positions} positions",
    )
    _agree(
        action.diffusion_steps <= action.diffusion_train_steps,
        f"{action.diffusion_steps} diffusion steps of {action.diffusion_train_steps} trained ones",
    )
    special = (prompt.bos_id, prompt.stop_id, prompt.trailing_id or 0)
    _agree(
        max(special) < backbone.vocab,
        f"special token ids {special} lie outside of a vocabulary of {backbone.vocab}",
    )
    _agree(_names_the_instruction(prompt.template), f"prompt template {prompt.template!r:.80}")


def _check_tower(tower: TowerConfig, hidden: int) -> None:
    name = f"a {tower.kind} tower of width {tower.dim}"
    _agree(
        tower.image_size % tower.patch_size == 0,
        f"pictures of {tower.image_size} pixels do not split into patches of {tower.patch_size}",
    )
    if tower.kind == "vit":
        _agree(
            tower.heads > 0 and tower.dim % tower.heads == 0,
            f"{name} does not split into {tower.heads} heads",
        )
        _agree(tower.depth >= 2, f"{name} needs at least 2 blocks, got {tower.depth}")
        _agree(tower.mlp_dim >= 1, f"{name} has no feed-forward width")
        _agree(
            tower.film_dim in (0, hidden),
            f"{name} listens to {tower.film_dim} values, the text embedding has {hidden}",
        )
    else:
        _agree(
            tower.stem_dim >= 1 and tower.patch_size % 4 == 0 and not tower.film_dim,
            f"{name} needs a stem and patches of a multiple of 4 pixels, without FiLM; got stem "
            f"{tower.stem_dim}, patches of {tower.patch_size}",
        )
        _agree(all(k % 2 for k in tower.kernels), f"{name} needs odd kernels, got {tower.kernels}")


def _names_the_instruction(template: str) -> bool:
    """Exactly one bare ``{instruction}``: a format string can otherwise read attributes, or fail."""
    try:
        parsed = list(Formatter().parse(template))
    except ValueError:
        return False
    return [(name, form, conv) for _, name, form, conv in parsed if name is not None] == [
        ("instruction", "", None)
    ]


def _agree(holds: bool, words: str) -> None:
    if not holds:
        raise CheckpointError(
            f"{words}: the configuration contradicts itself, the checkpoint is damaged or of another kind"
        )
