"""What the parent tells the child on its command line."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass


@dataclass(frozen=True)
class Options:
    """How the simulator is to run.

    Attributes:
        suite: e.g. ``"libero_spatial"``.
        assets: folder of meshes and textures.
        image_size: side of a picture in pixels.
        render: whether pictures will be asked for.
        plain: draw without shadows, reflections and multisampling.
    """

    suite: str
    assets: str
    image_size: int
    render: bool
    plain: bool

    def to_json(self) -> str:
        """One argument of a command line."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Options:
        """The inverse of :meth:`to_json`."""
        return cls(**json.loads(text))
