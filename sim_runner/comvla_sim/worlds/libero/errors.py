"""What can go wrong with a simulator in a process of its own."""

from __future__ import annotations

from comvla.errors import ComVLAError


class LiberoError(ComVLAError, RuntimeError):
    """The LIBERO simulator could not do what was asked."""


class AssetsError(LiberoError):
    """Meshes, textures or scenes are missing, or a pack of them cannot be unpacked."""


class SimulatorDiedError(LiberoError):
    """The simulator's process ended by itself. The message holds its last words on stderr."""


class SimulatorTimeoutError(LiberoError):
    """The simulator did not answer in time, and was ended."""


class ProtocolError(LiberoError):
    """The simulator's process sent something that is no answer."""


class ExpertError(LiberoError):
    """The scripted expert does not know how to do this task."""
