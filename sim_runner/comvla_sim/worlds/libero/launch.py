"""How a simulator is started: from LIBERO's environment, or from anything else that speaks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from comvla_sim.worlds.libero.assets import find_assets
from comvla_sim.worlds.libero.child.options import Options
from comvla_sim.worlds.libero.environment import LiberoEnvironment, default_home


@dataclass(frozen=True)
class Launch:
    """How a simulator is started.

    Attributes:
        command: its command line.
        variables: its environment variables.
        assets: ``"authentic"`` or ``"stand-in"``.
    """

    command: list[str]
    variables: Mapping[str, str]
    assets: str


def launch_from_environment(suite: str, image_size: int, *, render: bool, plain: bool) -> Launch:
    """How to start the simulator of LIBERO's environment on this machine.

    Raises:
        DependencyError: the environment is not set up, or nothing can draw.
        AssetsError: there are no assets.
    """
    environment = LiberoEnvironment(default_home())
    environment.require()
    assets = find_assets(environment.package(), environment.unpacked_assets)
    options = Options(suite, str(assets.folder), image_size, render, plain)
    return Launch(
        environment.command(options.to_json()), environment.variables(render=render), assets.label
    )
