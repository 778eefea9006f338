"""``comvla-sim bench``: one subcommand for each benchmark."""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from collections.abc import Callable
from typing import Any

from comvla.number_arguments import number, whole
from comvla_sim.bench import lifecycle_command


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Registers ``bench`` and its benchmarks."""
    parser = subparsers.add_parser(
        "bench",
        help="measure transport, edge computations, batching, model and link against their limits; fuzz",
        description="Each benchmark measures its own limit in the same run and reports ratios.",
    )
    benches = parser.add_subparsers(dest="bench", required=True, metavar="BENCH")
    for name, (text, add_options) in _BENCHES.items():
        bench = benches.add_parser(name, help=text, description=text)
        bench.add_argument("--json", action="store_true", help="print one JSON object")
        if name not in _UNREPEATED:
            bench.add_argument(
                "--repetitions", type=whole(1), help="timed calls (default: the bench's own)"
            )
            bench.add_argument(
                "--warm-up", type=whole(0), help="calls before them (default: the bench's own)"
            )
        add_options(bench)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Runs one benchmark and prints its table, or JSON with ``--json``."""
    if args.bench in lifecycle_command.RUNS:
        return _print(lifecycle_command.RUNS[args.bench](args, _given), args.json)
    result = {
        "transport": _transport,
        "edge": _edge,
        "batching": _batching,
        "model": _model,
        "wire": _wire,
        "idle": _idle,
        "overload": _overload,
        "soak": _soak,
        "fuzz": _fuzz,
    }[args.bench](args)
    return _print(result, args.json)


def _print(result: dict[str, Any], as_json: bool) -> int:
    print(json.dumps(result, indent=2) if as_json else _text(result))
    return 0 if result.get("passed", True) else 1


def _transport_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--k", dest="token_budget", type=whole(1), help="tokens (32)")


def _edge_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--k", dest="token_budget", type=whole(1), help="tokens (32)")
    parser.add_argument("--threads", type=whole(1), help="of the numerical libraries (1)")


def _batching_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--clients", type=whole(1), help="robots (16)")
    parser.add_argument("--max-batch", type=whole(2), help="of the batching server (8)")
    parser.add_argument("--model", help="mini, random or a checkpoint (mini)")
    parser.add_argument("--threads", type=whole(0), help="of torch in the server (1)")


def _model_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--size", choices=("7b", "mini"), help="OpenVLA-OFT's or mini's (mini)")
    parser.add_argument("--half", choices=("cloud", "edge"), help="which half (cloud)")
    parser.add_argument("--device", help="torch device (cpu)")
    parser.add_argument("--dtype", choices=("bfloat16", "float32"), help="(bfloat16)")
    parser.add_argument(
        "--k",
        dest="token_budgets",
        type=_token_budgets,
        metavar="K,K,…",
        help="visual tokens of a request to the cloud half (512,128,64,32,16)",
    )
    parser.add_argument("--prompt-tokens", type=whole(1), help="of the prompt (30)")
    parser.add_argument(
        "--layers", type=whole(1), help="of the backbone, fewer for less memory (all)"
    )
    parser.add_argument("--threads", type=whole(0), help="of torch (its own choice)")
    parser.add_argument(
        "--cpu-time",
        action="store_true",
        default=None,
        help="processor seconds, for a machine that others share; with --threads 1",
    )
    parser.add_argument(
        "--compile", action="store_true", default=None, help="the cloud half through torch.compile"
    )


def _wire_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--k", dest="token_budgets", type=_token_budgets, metavar="K,K,…", help="(1 to 512)"
    )
    parser.add_argument(
        "--quantization",
        dest="quantizations",
        type=lambda text: tuple(text.split(",")),
        metavar="NAME,…",
        help="(all)",
    )
    _link_options(parser, "as fast as the machine")
    parser.add_argument("--mtu", dest="mtu_bytes", type=whole(576), help="bytes (1500)")


def _idle_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--k", dest="token_budget", type=whole(1), help="tokens (32)")
    parser.add_argument("--silence-s", type=number(0.0), help="before each query (1.2)")
    _link_options(parser, "26.3, the paper's link at 10 dB")


def _fleet_options(parser: argparse.ArgumentParser, model: str, tokens: int) -> None:
    parser.add_argument("--robots", type=whole(1), help="(64)")
    parser.add_argument("--k", dest="token_budget", type=whole(1), help=f"tokens ({tokens})")
    parser.add_argument("--max-batch", type=whole(1), help="of the server (8)")
    parser.add_argument(
        "--model",
        help="stub (a pass takes a fixed time and no processor, which shows the scheduler alone), "
        f"mini, random or a checkpoint ({model})",
    )
    parser.add_argument("--threads", type=whole(0), help="of torch in the server (1)")
    parser.add_argument("--capacity-s", type=number(0.1), help="in which capacity is measured")


def _overload_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--loads",
        type=lambda text: tuple(number(0.01)(part) for part in text.split(",")),
        metavar="X,X,…",
        help="offered, as multiples of the capacity measured (1.5,10)",
    )
    _fleet_options(parser, "stub", 128)
    parser.add_argument(
        "--cases",
        type=lambda text: tuple(text.split(",")),
        metavar="NAME,NAME,…",
        help="of admission off, admission, advised K and back-off, each with what is before it (all)",
    )
    parser.add_argument("--seconds", type=number(0.1), help="of each load (10)")
    parser.add_argument("--settle-s", type=number(0.0), help="before them, not counted (3)")
    parser.add_argument(
        "--deadline-passes", type=number(0.1), help="deadline, in passes of a full batch (4)"
    )


def _soak_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--minutes", type=number(0.01), help="(30)")
    parser.add_argument("--load", type=number(0.01), help="as a multiple of the capacity (0.8)")
    _fleet_options(parser, "mini", 32)
    parser.add_argument("--deadline-s", type=number(0.001), help="of a request (1)")


def _link_options(parser: argparse.ArgumentParser, rate: str) -> None:
    parser.add_argument("--delay-ms", type=number(0.0), help="one way (wire: 0, idle: 20)")
    parser.add_argument("--mbit-per-s", type=number(0.001), help=f"rate of the link ({rate})")


def _fuzz_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--requests", type=whole(1), help="mutated requests (10000)")
    parser.add_argument("--seed", type=whole(), help="of all of them (0)")
    parser.add_argument("--only", type=whole(), metavar="CASE", help="one case, by its number")
    parser.add_argument(
        "--seconds", type=number(), metavar="S", help="begin no case after (no limit)"
    )
    parser.add_argument("--processes", type=whole(1), help="at work in process at once (2)")


_BENCHES: dict[str, tuple[str, Callable[[argparse.ArgumentParser], None]]] = {
    "transport": ("68 KiB up, 1 KiB down, against raw TCP and a websocket", _transport_options),
    "edge": ("vote, select, quantise, pack, against a matrix product", _edge_options),
    "batching": ("many robots on one server, against batches of one", _batching_options),
    "model": ("one half with random weights, against bare matrix products", _model_options),
    "wire": ("accounted bytes of a query, against a packet capture (root)", _wire_options),
    "idle": (
        "a query after a silence, against one without, remedy by remedy (root)",
        _idle_options,
    ),
    "overload": (
        "more robots than a server can answer, with admission off and on, with advised K",
        _overload_options,
    ),
    "soak": (
        "memory and descriptors of a server under steady load; exit code 1 where they grow",
        _soak_options,
    ),
    "fuzz": ("hostile requests, against crashes, leaks and wrong status codes", _fuzz_options),
    **lifecycle_command.BENCHES,
}
_UNREPEATED = {"overload", "soak", "fuzz"}


def _transport(args: argparse.Namespace) -> dict[str, Any]:
    from comvla_sim.bench import transport

    return transport.run(_given(transport.TransportParameters, args))


def _edge(args: argparse.Namespace) -> dict[str, Any]:
    from comvla_sim.bench import edge

    return edge.run(_given(edge.EdgeParameters, args))


def _batching(args: argparse.Namespace) -> dict[str, Any]:
    from comvla_sim.bench import batching

    return batching.run(_given(batching.BatchingParameters, args))


def _model(args: argparse.Namespace) -> dict[str, Any]:
    from comvla_sim.bench import model

    return model.run(_given(model.ModelParameters, args))


def _wire(args: argparse.Namespace) -> dict[str, Any]:
    from comvla_sim.netlink import wire_bench
    from comvla_sim.netlink.command import progress

    with progress("queries") as on_query:
        return wire_bench.run(_given(wire_bench.WireParameters, args), on_query)


def _idle(args: argparse.Namespace) -> dict[str, Any]:
    from comvla_sim.netlink import idle_bench

    parameters = _given(idle_bench.IdleParameters, args)
    return idle_bench.run(parameters, on_case=lambda name: print(name, file=sys.stderr, flush=True))


def _overload(args: argparse.Namespace) -> dict[str, Any]:
    from comvla_sim.bench import overload

    parameters = _given(overload.OverloadParameters, args)
    return overload.run(parameters, lambda name: print(name, file=sys.stderr, flush=True))


def _soak(args: argparse.Namespace) -> dict[str, Any]:
    from comvla_sim.bench import soak
    from comvla_sim.netlink.command import progress

    parameters = _given(soak.SoakParameters, args)
    total = round(60.0 * parameters.minutes)
    with progress("seconds") as show:
        return soak.run(parameters, lambda seconds: show(min(int(seconds), total), total))


def _fuzz(args: argparse.Namespace) -> dict[str, Any]:
    from comvla_sim.fuzz.run import FuzzParameters, run
    from comvla_sim.netlink.command import progress

    with progress("requests") as on_request:
        return run(_given(FuzzParameters, args), on_request)


def _given(parameters: Callable[..., Any], args: argparse.Namespace) -> Any:
    """The parameters with what the command line named, and defaults for the rest."""
    names = {field.name for field in dataclasses.fields(parameters)}  # type: ignore[arg-type]
    return parameters(**{k: v for k, v in vars(args).items() if k in names and v is not None})


def _token_budgets(text: str) -> tuple[int, ...]:
    return tuple(whole(1)(part) for part in text.split(","))


def _text(result: dict[str, Any]) -> str:
    from comvla_sim.bench.report import describe

    return describe(result)
