"""Keeps a link up in the background: what ``comvla-sim link up`` leaves behind.

Run as ``python -m comvla_sim.netlink.keeper ARGUMENT...`` with the arguments of ``link up``. One line
on standard output says that the link is there, or why not; SIGTERM takes it down.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from typing import Any

from comvla.errors import ComVLAError, LinkError
from comvla_sim.netlink import namespaces, wires
from comvla_sim.netlink.arguments import add_channel, add_link, channel_of, link_of
from comvla_sim.netlink.link import NamespaceLink
from comvla_sim.netlink.namespaces import LinkName

_UP_WITHIN_S = 60.0
_DOWN_WITHIN_S = 15.0


def start(arguments: Sequence[str]) -> dict[str, Any]:
    """Starts a keeper that outlives this process.

    Returns:
        ``name``, ``robot``, ``cloud``, ``cloud_address`` and the link's settings.

    Raises:
        LinkError: the link did not come up; with the keeper's reason.
    """
    # Not this process's own standard error: who waits for its end must not wait for the link's.
    with tempfile.TemporaryFile("w+") as complaints:
        process = subprocess.Popen(
            [sys.executable, "-m", "comvla_sim.netlink.keeper", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=complaints,
            text=True,
            start_new_session=True,
        )
        assert process.stdout is not None
        with process.stdout:
            line = process.stdout.readline()
        complaints.seek(0)
        last = (complaints.read().strip().splitlines() or ["it ended without a word"])[-1]
    said: dict[str, Any] = json.loads(line) if line else {"error": last}
    if "error" in said:
        process.wait(_UP_WITHIN_S)
        raise LinkError(said["error"])
    return said


def stop(link: LinkName) -> None:
    """Takes a link down, also where its keeper is dead; waits until it is gone."""
    if link.alive:
        os.kill(link.pid, signal.SIGTERM)
        deadline = time.monotonic() + _DOWN_WITHIN_S
        while link.alive and time.monotonic() < deadline:
            time.sleep(0.05)
        if link.alive:
            os.kill(link.pid, signal.SIGKILL)
    namespaces.remove_link(link)


def main(argv: Sequence[str]) -> int:
    """Keeps a link until SIGTERM."""
    parser = argparse.ArgumentParser(prog="python -m comvla_sim.netlink.keeper")
    add_channel(parser)
    add_link(parser)
    arguments = parser.parse_args(argv)
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, _interrupt)
    try:
        channel = channel_of(arguments)
        with NamespaceLink(link_of(arguments)) as link:
            link.follow(channel)
            _say(
                {
                    "name": link.name.text,
                    "pid": link.name.pid,
                    "robot": link.robot,
                    "cloud": link.cloud,
                    "robot_address": wires.ROBOT_ADDRESS,
                    "cloud_address": wires.CLOUD_ADDRESS,
                    "settings": link.describe(),
                }
            )
            while True:
                time.sleep(1.0)
                link.punctuality()  # raises where the device has vanished
    except KeyboardInterrupt:
        return 0
    except ComVLAError as error:
        _say({"error": str(error)})
        return 2


def _say(what: dict[str, Any]) -> None:
    try:
        print(json.dumps(what), flush=True)
        # Whoever started this one has read its line and goes: nothing may be written there later.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except OSError:
        return


def _interrupt(number: int, frame: object) -> None:
    raise KeyboardInterrupt


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
