"""Removes a link's namespaces when its keeper is gone, however it went: also by SIGKILL.

Run as ``python -m comvla_sim.netlink.guardian PID STARTED NUMBER`` with standard input tied to the
keeper: the end of the file is the keeper's end. Imports little, to be there at once.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Iterator

from comvla_sim.netlink.namespaces import LinkName, remove_link


@contextlib.contextmanager
def guarding(link: LinkName) -> Iterator[None]:
    """Starts a guardian; its link's namespaces go with the block, or with this process."""
    name = [str(link.pid), str(link.started), str(link.number)]
    command = [sys.executable, "-m", "comvla_sim.netlink.guardian", *name]
    # A session of its own: Ctrl-C must not end it before its work is done.
    process = subprocess.Popen(command, stdin=subprocess.PIPE, start_new_session=True)
    try:
        yield
    finally:
        remove_link(link)
        assert process.stdin is not None
        process.stdin.close()
        process.wait()


def main(argv: list[str]) -> int:
    """Waits for the keeper's end, then removes what it left."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    link = LinkName(*map(int, argv))
    while os.read(sys.stdin.fileno(), 1024):
        pass
    remove_link(link)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
