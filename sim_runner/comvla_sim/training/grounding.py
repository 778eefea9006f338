"""What each word of an instruction should look at: supervision of the votes, at training time only.

Without it all words of a small policy vote for one or two tokens, and the tie-break would be the selector. Each word
has several language queries; each is drawn towards one kind of point in one view, as a small Gaussian over the token
grid. The points come from the simulator, so votes of this policy are *supervised with positions that only a simulator
knows*: that they work says nothing about whether voting emerges by itself in a large pre-trained policy.
"""

from __future__ import annotations

import torch
from torch import Tensor

# Kinds of points, in the order in which the demonstrations store them.
HAND, OBJECT, GOAL, FIXTURE = 0, 1, 2, 3

# (kind, view) of each query of a word, by the word's role.
_ROLES: dict[str, tuple[tuple[int, int], ...]] = {
    "verb": ((OBJECT, 0), (OBJECT, 1), (GOAL, 0), (GOAL, 1)),
    "article": ((HAND, 0), (HAND, 1), (HAND, 0), (HAND, 1)),
    "colour": ((FIXTURE, 0), (FIXTURE, 1), (OBJECT, 0), (OBJECT, 1)),
    "noun": ((OBJECT, 0), (OBJECT, 1), (FIXTURE, 0), (FIXTURE, 1)),
    "manner": ((GOAL, 0), (GOAL, 1), (OBJECT, 0), (OBJECT, 1)),
}
_WORDS = {
    "verb": "pull push press turn lower slide",
    "article": "the",
    "colour": "green yellow grey black brown",
    "noun": "drawer button faucet lever window",
    "manner": "open shut firmly gently left right leftwards rightwards",
}
ROLE_OF_WORD = {word: role for role, words in _WORDS.items() for word in words.split()}
QUERIES_PER_WORD = 4


def query_targets(words: list[str]) -> list[tuple[int, int]]:
    """(kind of point, view) for each query of a prompt, in the order of its words.

    Raises:
        KeyError: a word without a role; give it one before training on it.
    """
    return [target for word in words for target in _ROLES[ROLE_OF_WORD[word]]]


def target_maps(uv: Tensor, grid: tuple[int, int, int], sigma: float = 0.7) -> Tensor:
    """Gaussians over the token grid around projected points.

    Args:
        uv: (B, views, kinds, 2) horizontal and vertical picture coordinates in [0, 1].
        grid: (views, rows, columns).
        sigma: standard deviation in cells.

    Returns:
        (B, kinds, views, rows * columns), unnormalised.
    """
    _, rows, columns = grid
    across = uv[..., 0:1] * columns - 0.5 - torch.arange(columns)
    down = uv[..., 1:2] * rows - 0.5 - torch.arange(rows)
    bell = torch.exp(-0.5 * (down[..., :, None] ** 2 + across[..., None, :] ** 2) / sigma**2)
    return bell.flatten(-2).transpose(1, 2) + 1e-8


def grounding_targets(uv: Tensor, wanted: Tensor, grid: tuple[int, int, int]) -> Tensor:
    """Target distribution of every query.

    Args:
        uv: (B, views, kinds, 2) picture coordinates in [0, 1]. wanted: (B, Q, 2) kind and view of each query.
        grid: (views, rows, columns).

    Returns:
        (B, Q, N) distributions over tokens; a query's other views hold zeros.
    """
    maps = target_maps(uv, grid)
    batch = torch.arange(len(uv))[:, None]
    kind, view = wanted.unbind(-1)
    chosen = maps[batch, kind, view]
    chosen = chosen / chosen.sum(-1, keepdim=True)
    out = chosen.new_zeros(*kind.shape, grid[0], chosen.shape[-1])
    out.scatter_(2, view[..., None, None].expand(-1, -1, 1, chosen.shape[-1]), chosen[:, :, None])
    return out.flatten(2)
