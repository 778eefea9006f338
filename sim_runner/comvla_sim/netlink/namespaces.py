"""Network namespaces of a link: named by who made them, entered by threads, never left behind."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import itertools
import os
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from comvla.errors import DependencyError, LinkError

if TYPE_CHECKING:
    from pyroute2 import IPRoute

NAMESPACE_FOLDER = Path("/run/netns")
"""Where Linux keeps named namespaces, and `ip netns` looks for them."""

ROLES = ("robot", "air", "cloud")
"""``air`` exists only where the link has a propagation delay: the relay sits in it."""

_NAME = re.compile(r"comvla-(\d+)-(\d+)-(\d+)-(robot|air|cloud)")
_NUMBERS = itertools.count(1)
_CLONE_NEWNET = 0x4000_0000
_MNT_DETACH = 2
_MS_BIND = 4096


@dataclass(frozen=True)
class LinkName:
    """Whose link it is: the process that keeps it, told apart from a later one of the same number.

    Attributes:
        pid: of the process that keeps the link.
        started: when that process began, in clock ticks since boot.
        number: of the link among those of the process.
    """

    pid: int
    started: int
    number: int

    @property
    def text(self) -> str:
        """All of it, as the names of the namespaces begin."""
        return f"comvla-{self.pid}-{self.started}-{self.number}"

    def namespace(self, role: str) -> str:
        """Name of one of its namespaces, e.g. for ``ip netns exec``."""
        return f"{self.text}-{role}"

    @property
    def alive(self) -> bool:
        """Whether the process that keeps it still runs."""
        return _started(self.pid) == self.started

    @staticmethod
    def of_this_process() -> LinkName:
        """A name for another link that this process keeps."""
        started = _started(os.getpid())
        assert started is not None, "a process that asks is alive"
        return LinkName(os.getpid(), started, next(_NUMBERS))


def check_privileges() -> None:
    """Makes sure that this process may make namespaces and shape a link.

    Raises:
        LinkError: not Linux, or not root; says what to use instead.
        DependencyError: pyroute2 is not installed.
    """
    instead = "use the link in simulated time instead (comvla_sim.link, `comvla-sim demo`)"
    if not sys.platform.startswith("linux"):
        raise LinkError(
            f"a link of network namespaces needs Linux, this is {sys.platform}: {instead}"
        )
    if os.geteuid() != 0:
        raise LinkError(
            "a link of network namespaces needs root, to make network devices: run the command with "
            f"sudo (sudo .venv/bin/comvla-sim link ...), or {instead}"
        )
    try:
        import pyroute2  # noqa: F401
    except ImportError as error:
        raise DependencyError(
            "a link of network namespaces needs pyroute2: pip install 'comvla[sim]'"
        ) from error
    with _anonymous_namespace():
        pass


def create(name: str) -> None:
    """Makes a named namespace with its loopback device up.

    Raises:
        LinkError: the system does not let this process.
    """
    path = NAMESPACE_FOLDER / name
    with _anonymous_namespace():
        try:
            NAMESPACE_FOLDER.mkdir(parents=True, exist_ok=True)
            path.touch(mode=0o400, exist_ok=False)
            here = b"/proc/thread-self/ns/net"
            if _libc().mount(here, os.fsencode(path), b"none", _MS_BIND, None) != 0:
                raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
        except OSError as error:
            remove(name)
            raise _refused(error) from error
        for family in ("all", "default"):
            with contextlib.suppress(OSError):  # kernels without IPv6 have no such file
                Path(f"/proc/sys/net/ipv6/conf/{family}/disable_ipv6").write_text("1", "ascii")
    with routes_in(name) as routes:
        routes.link("set", index=1, state="up")


@contextlib.contextmanager
def routes_in(name: str) -> Iterator[IPRoute]:
    """The devices, addresses and routes of a namespace, to be read and changed.

    Raises:
        LinkError: there is no such namespace.
    """
    from pyroute2 import IPRoute

    # Opened from inside, where pyroute2 by itself would fork this process.
    with entered(name):
        routes = IPRoute()
    with routes:
        yield routes


def remove(name: str) -> None:
    """Removes a named namespace; harmless where there is none.

    Its devices go when the last process in it has ended.
    """
    path = NAMESPACE_FOLDER / name
    with contextlib.suppress(OSError):
        _libc().umount2(os.fsencode(path), _MNT_DETACH)
        path.unlink()


def remove_link(link: LinkName) -> None:
    """Removes all namespaces of a link."""
    for role in ROLES:
        remove(link.namespace(role))


def links() -> list[LinkName]:
    """All links that have namespaces on this machine, also those whose process is dead."""
    try:
        names = sorted(os.listdir(NAMESPACE_FOLDER))
    except OSError:
        return []
    found = (_NAME.fullmatch(name) for name in names)
    return list(dict.fromkeys(LinkName(int(m[1]), int(m[2]), int(m[3])) for m in found if m))


def remove_leftovers() -> list[LinkName]:
    """Removes the namespaces of links whose process is dead.

    Returns:
        Those links.
    """
    dead = [link for link in links() if not link.alive]
    for link in dead:
        remove_link(link)
    return dead


@contextlib.contextmanager
def entered(name: str) -> Iterator[None]:
    """Puts this thread, and it alone, into a namespace until the block ends.

    Sockets that are opened inside stay there; threads and processes that are started inside, too.

    Raises:
        LinkError: there is no such namespace, or the system does not let this process.
    """
    before = os.open("/proc/thread-self/ns/net", os.O_RDONLY | os.O_CLOEXEC)
    try:
        enter(name)
        try:
            yield
        finally:
            _set_namespace(before)
    finally:
        os.close(before)


def enter(name: str) -> None:
    """Puts this thread into a namespace for good.

    Raises:
        LinkError: there is no such namespace, or the system does not let this process.
    """
    try:
        there = os.open(NAMESPACE_FOLDER / name, os.O_RDONLY | os.O_CLOEXEC)
    except OSError as error:
        raise LinkError(
            f"expected a network namespace {name}, and there is none ({error.strerror}): the link "
            "was taken down; `comvla-sim link status` lists those that are up"
        ) from error
    try:
        _set_namespace(there)
    finally:
        os.close(there)


@contextlib.contextmanager
def _anonymous_namespace() -> Iterator[None]:
    """A try: whether this thread may have a namespace of its own. It does not outlive the block."""
    before = os.open("/proc/thread-self/ns/net", os.O_RDONLY | os.O_CLOEXEC)
    try:
        if _libc().unshare(_CLONE_NEWNET) != 0:
            raise _refused(OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno())))
        try:
            yield
        finally:
            _set_namespace(before)
    finally:
        os.close(before)


def _set_namespace(descriptor: int) -> None:
    if _libc().setns(descriptor, _CLONE_NEWNET) != 0:
        number = ctypes.get_errno()
        raise _refused(OSError(number, os.strerror(number)))


def _refused(error: OSError) -> LinkError:
    why = "may not" if error.errno in (errno.EPERM, errno.EACCES) else "cannot"
    return LinkError(
        f"this process {why} make network namespaces ({error}): in a container, start it with "
        "--cap-add NET_ADMIN --cap-add SYS_ADMIN; or use the link in simulated time "
        "(comvla_sim.link)"
    )


def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)


def _started(pid: int) -> int | None:
    """Start of a process in clock ticks since boot; None where there is none, or only its remains."""
    try:
        line = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return None
    # The name in brackets may hold anything; after it come state (a zombie is dead) and numbers.
    fields = line.rpartition(")")[2].split()
    return None if fields[0] in "ZX" else int(fields[19])
