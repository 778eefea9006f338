"""``comvla-sim link up | run | flaps | status | down``."""

from __future__ import annotations

import argparse
import json
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from comvla.errors import LinkError
from comvla.number_arguments import SEED, number, whole

_DESCRIPTION = """\
A real link on this machine: a robot and a cloud in network namespaces of their own, and between them
a shaped cable whose rate follows a channel, period after period. Real TCP, real gRPC, real time.
Needs Linux and root. Everything is taken down again, whatever ends the command.
"""
_EPILOG = """\
examples:
  comvla-sim link up --channel rician --snr-db 10
  comvla-sim link run --scale paper --sending margin --minutes 5
  comvla-sim link run --scale mini --sending progressive --every 8 --json
  comvla-sim link flaps --count 50
  comvla-sim link down
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Registers ``link`` and its commands."""
    from comvla_client.sending import POLICIES
    from comvla_sim.netlink.arguments import add_channel, add_link

    parser = subparsers.add_parser(
        "link",
        help="run robot and server over a real, shaped link between network namespaces",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(dest="link", required=True, metavar="COMMAND")

    up = commands.add_parser("up", help="make a link that stays, and say how to use it")
    add_channel(up)
    add_link(up)

    run_ = commands.add_parser(
        "run", help="a robot that asks every period, and the account of what was in time"
    )
    run_.add_argument(
        "--scale",
        choices=("paper", "mini"),
        default="paper",
        help="the paper's sizes with synthetic content on 20 MHz, or the shipped policy on 0.88 MHz "
        "(paper)",
    )
    run_.add_argument(
        "--sending", choices=tuple(POLICIES), default="margin", help="policy of sending (margin)"
    )
    run_.add_argument("--minutes", type=number(), default=1.0, help="how long (1)")
    run_.add_argument(
        "--every", type=whole(), default=1, metavar="PERIODS", help="from query to query (1)"
    )
    run_.add_argument(
        "--csi-delay",
        type=whole(),
        default=0,
        metavar="PERIODS",
        help="age of the reported SNR (0)",
    )
    run_.add_argument(
        "--budget", choices=("paper", "framed"), help="what is counted (the policy's own)"
    )
    run_.add_argument(
        "--reserve-ms",
        type=number(),
        metavar="MS",
        help="kept of the period for computing and the way back (measured first)",
    )
    run_.add_argument(
        "--realtime",
        action="store_true",
        help="robot and server run before ordinary processes: for figures on a shared machine",
    )
    run_.add_argument("--out", type=Path, help="also write the whole account, query by query")
    add_channel(run_)
    add_link(run_)

    flaps = commands.add_parser("flaps", help="cut the link again and again under a robot")
    flaps.add_argument("--count", type=whole(), default=50, help="flaps (50)")
    flaps.add_argument("--shortest-s", type=number(), default=0.1, metavar="S", help="(0.1)")
    flaps.add_argument("--longest-s", type=number(), default=3.0, metavar="S", help="(3)")
    flaps.add_argument("--delay-ms", type=number(), default=0.0, metavar="MS", help="one way (0)")
    flaps.add_argument(
        "--deadline-ms",
        type=number(),
        default=50.0,
        metavar="MS",
        help="of a step (50, one period)",
    )
    flaps.add_argument(
        "--at",
        choices=("cloud", "robot"),
        default="cloud",
        help="cloud: packets are lost silently, as in a fade; robot: its device loses the carrier",
    )
    flaps.add_argument("--seed", type=SEED, default=0, help="of lengths and moments (0)")

    flaps.add_argument(
        "--realtime", action="store_true", help="robot and server run before ordinary processes"
    )
    status = commands.add_parser("status", help="list links, also what dead ones left")
    down = commands.add_parser("down", help="take links down, and remove what dead ones left")
    down.add_argument("name", nargs="?", help="of one link, as status shows it (all)")
    for command in (up, run_, flaps, status, down):
        command.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Runs one command; 130 after Ctrl-C or SIGTERM, which take the link down first."""
    with _terminated_like_interrupted():
        try:
            return {"up": _up, "run": _run, "flaps": _flaps, "status": _status, "down": _down}[
                args.link
            ](args)
        except KeyboardInterrupt:
            print("stopped; the link is down", file=sys.stderr)
            return 130


def _up(args: argparse.Namespace) -> int:
    from comvla_sim.netlink import keeper
    from comvla_sim.netlink.arguments import as_list, channel_of, link_of
    from comvla_sim.netlink.namespaces import check_privileges

    check_privileges()
    link_of(args), channel_of(args)  # a mistake is told here, not by the keeper
    up = keeper.start(as_list(args))
    if args.json:
        print(json.dumps(up))
        return 0
    print(
        f"link {up['name']} is up.\n"
        f"  cloud:  ip netns exec {up['cloud']} comvla-server serve --host {up['cloud_address']} "
        "--insecure\n"
        f"  robot:  ip netns exec {up['robot']} comvla doctor {up['cloud_address']}:50051\n"
        f"  down:   comvla-sim link down {up['name']}"
    )
    return 0


def _run(args: argparse.Namespace) -> int:
    from comvla_sim.netlink import run as runs
    from comvla_sim.netlink.arguments import channel_of
    from comvla_sim.netlink.wording import describe_run

    settings = runs.RunSettings(
        scale=args.scale,
        sending=args.sending,
        minutes=args.minutes,
        every=args.every,
        csi_delay=args.csi_delay,
        budget=args.budget,
        reserve_s=None if args.reserve_ms is None else args.reserve_ms / 1e3,
        mean_snr_db=args.snr_db,
        bandwidth_hz=args.bandwidth_hz,
        period_s=args.period_s,
        efficiency=args.efficiency,
        delay_s=args.delay_ms / 1e3,
        mtu_bytes=args.mtu,
        congestion_control=args.congestion_control,
        sysctls=tuple({"tcp_slow_start_after_idle": "0", **dict(args.sysctl)}.items()),
        realtime=args.realtime,
    )
    with progress("queries") as on_progress:
        account = runs.run(settings, channel_of(args), on_progress)
    if args.out is not None:
        args.out.parent.mkdir(parents=True, exist_ok=True)
        args.out.write_text(json.dumps(account), encoding="utf-8")
    del account["queries"]
    print(json.dumps(account) if args.json else describe_run(account))
    return 0


def _flaps(args: argparse.Namespace) -> int:
    from comvla_sim.netlink import flaps
    from comvla_sim.netlink.wording import describe_flaps

    parameters = flaps.FlapParameters(
        count=args.count,
        shortest_s=args.shortest_s,
        longest_s=args.longest_s,
        delay_ms=args.delay_ms,
        deadline_s=args.deadline_ms / 1e3,
        at=args.at,
        seed=args.seed,
        realtime=args.realtime,
    )
    with progress("flaps") as on_progress:
        account = flaps.run(parameters, lambda done: on_progress(done, args.count))
    print(json.dumps(account) if args.json else describe_flaps(account))
    return 0


def _status(args: argparse.Namespace) -> int:
    from comvla_sim.netlink import namespaces

    rows = [
        {
            "name": link.text,
            "pid": link.pid,
            "alive": link.alive,
            "robot": link.namespace("robot"),
            "cloud": link.namespace("cloud"),
        }
        for link in namespaces.links()
    ]
    if args.json:
        print(json.dumps({"links": rows}))
    for row in () if args.json else rows:
        state = (
            f"kept by process {row['pid']}" if row["alive"] else "left over; link down removes it"
        )
        print(f"{row['name']}  {state}")
    if not rows and not args.json:
        print("no links")
    return 0


def _down(args: argparse.Namespace) -> int:
    from comvla_sim.netlink import keeper, namespaces

    found = namespaces.links()
    chosen = [link for link in found if args.name in (None, link.text)]
    if args.name is not None and not chosen:
        names = ", ".join(link.text for link in found) or "none"
        raise LinkError(f"there is no link {args.name!r}; links here: {names}")
    if chosen:
        namespaces.check_privileges()
    for link in chosen:
        keeper.stop(link)
        if not args.json:
            print(f"{link.text} is down")
    if args.json:
        print(json.dumps({"down": [link.text for link in chosen]}))
    return 0


@contextmanager
def progress(what: str) -> Iterator[Callable[[int, int], None]]:
    """A progress bar on a terminal, a line at every tenth elsewhere; on stderr."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    console = Console(stderr=True)
    if not console.is_terminal:
        tenth = 0

        def line(done: int, total: int) -> None:
            nonlocal tenth
            if done * 10 // total > tenth:
                tenth = done * 10 // total
                print(f"{done}/{total} {what}", file=sys.stderr, flush=True)

        yield line
        return
    columns = (TextColumn(what), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console) as shown:
        bar = shown.add_task("", total=None)
        yield lambda done, total: shown.update(bar, completed=done, total=total)


@contextmanager
def _terminated_like_interrupted() -> Iterator[None]:
    """SIGTERM and SIGHUP unwind the stack as Ctrl-C does, so that the link is taken down."""

    def interrupt(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    numbers = (signal.SIGTERM, signal.SIGHUP)
    before: dict[signal.Signals, Any] = {}
    try:
        for number in numbers:
            before[number] = signal.signal(number, interrupt)
    except ValueError:  # not the main thread, e.g. a test
        before = {}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
