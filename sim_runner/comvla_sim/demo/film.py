"""Pictures for people: larger than the policy's, from the same cameras at the same moments."""

from __future__ import annotations

import base64
import io
from typing import TYPE_CHECKING

import numpy as np

from comvla_sim.worlds.rendering import Renderer

if TYPE_CHECKING:
    from comvla_sim.worlds.base import World

FILM_SIZE = 320
"""Side of a view in pixels."""


class FilmCamera:
    """Draws the present moment of a world as one coded picture, the views side by side.

    Args:
        world: the policy's own pictures of it stay as they are.
        size: side of a view in pixels.
    """

    def __init__(self, world: World, size: int = FILM_SIZE) -> None:
        self._world = world
        self._size = size
        self._renderer: Renderer | None = None

    def shoot(self) -> str:
        """A data URI of a picture (size, views · size)."""
        from PIL import Image, features

        if self._renderer is None:  # the world has its model only after its own first picture
            self._renderer = Renderer(self._world.model, self._size)
        views = self._renderer.draw(self._world.data)
        buffer = io.BytesIO()
        # WebP is half as large as JPEG; a Pillow without it is rare.
        kind = "webp" if features.check("webp") else "jpeg"
        Image.fromarray(np.concatenate(list(views), axis=1)).save(buffer, kind, quality=72)
        return f"data:image/{kind};base64,{base64.b64encode(buffer.getvalue()).decode()}"

    def close(self) -> None:
        """Frees the renderer."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
