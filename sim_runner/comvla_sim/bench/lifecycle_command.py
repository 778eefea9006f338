"""``comvla-sim bench kills | swap | replicas``: what a server's life costs the robots that use it."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

from comvla.number_arguments import SECONDS, SEED, whole

Given = Callable[[Callable[..., Any], argparse.Namespace], Any]
"""Makes parameters of what the command line named."""


def _kills_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--kills", type=whole(0), help="of the server, over all episodes (10)")
    parser.add_argument("--episodes", type=whole(1), help="each run with and without kills (10)")
    parser.add_argument("--model", help="mini or a checkpoint (mini)")
    parser.add_argument("--world", help="world (tabletop)")
    parser.add_argument("--k", dest="token_budget", type=whole(1), help="tokens (64)")
    parser.add_argument("--deadline-s", type=SECONDS, help="of a query (0.4)")
    parser.add_argument("--seed", type=SEED, help="of tables and kills (0)")


def _load_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--clients", type=whole(1), help="robots that ask all the time (4)")
    parser.add_argument("--k", dest="token_budget", type=whole(1), help="tokens (32)")
    parser.add_argument("--deadline-s", type=SECONDS, help="of a query (swap 1, replicas 5)")
    parser.add_argument("--model", help="mini or a checkpoint (mini)")
    parser.add_argument("--seed", type=SEED, help="of the tokens (0)")


def _swap_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--swaps", type=whole(1), help="of the model (6)")
    parser.add_argument("--between-s", type=SECONDS, help="load before each swap (2)")
    _load_options(parser)


def _replicas_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seconds", type=SECONDS, help="of load in each case (5)")
    parser.add_argument(
        "--only", choices=("plain", "ray"), help="plain servers or Ray's replicas alone (both)"
    )
    _load_options(parser)


def _kills(args: argparse.Namespace, given: Given) -> dict[str, Any]:
    from comvla_sim.bench import kills
    from comvla_sim.netlink.command import progress

    with progress("episodes") as on_episode:
        return kills.run(given(kills.KillParameters, args), on_episode)


def _swap(args: argparse.Namespace, given: Given) -> dict[str, Any]:
    from comvla_sim.bench import swaps
    from comvla_sim.netlink.command import progress

    with progress("swaps") as on_swap:
        return swaps.run(given(swaps.SwapParameters, args), on_swap)


def _replicas(args: argparse.Namespace, given: Given) -> dict[str, Any]:
    from comvla_sim.bench import replicas
    from comvla_sim.netlink.command import progress

    with progress("cases") as on_case:
        return replicas.run(given(replicas.ReplicaParameters, args), on_case)


BENCHES: dict[str, tuple[str, Callable[[argparse.ArgumentParser], None]]] = {
    "kills": (
        "episodes while the server is killed and restarted, against none of it",
        _kills_options,
    ),
    "swap": ("hot swaps of the model under load: calls that failed", _swap_options),
    "replicas": (
        "two servers against one, plain and behind Ray, and one of them killed",
        _replicas_options,
    ),
}
RUNS: dict[str, Callable[[argparse.Namespace, Given], dict[str, Any]]] = {
    "kills": _kills,
    "swap": _swap,
    "replicas": _replicas,
}
