"""A TCP relay in front of a server: slow, far, forgetful, or sleepy, as a radio may be."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress


class Relay:
    """Passes bytes on, in its own thread.

    Args:
        target: ``host:port`` of the server.
        up_bits_per_s: what passes towards the server; None for as much as comes.
        delay_s: propagation delay, each way.
        wake_s: added to what comes up after a second of silence, as a slow start would.
        forgets_s: a connection silent for so long is cut.
    """

    CHUNK_BYTES = 4096

    def __init__(
        self,
        target: str,
        *,
        up_bits_per_s: float | None = None,
        delay_s: float = 0.0,
        wake_s: float = 0.0,
        forgets_s: float | None = None,
    ) -> None:
        host, _, port = target.rpartition(":")
        self._server = (host, int(port))
        self._up_bits_per_s = up_bits_per_s
        self._delay_s = delay_s
        self._wake_s = wake_s
        self._forgets_s = forgets_s
        self._loop = asyncio.new_event_loop()
        self._started = threading.Event()
        self._stop = asyncio.Event()
        self.target = ""
        self._thread = threading.Thread(target=lambda: self._loop.run_until_complete(self._run()))

    def start(self) -> None:
        self._thread.start()
        assert self._started.wait(20)

    def stop(self) -> None:
        self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join(20)
        self._loop.close()

    async def _run(self) -> None:
        listening = await asyncio.start_server(self._connected, "127.0.0.1", 0)
        host, port = listening.sockets[0].getsockname()
        self.target = f"{host}:{port}"
        self._started.set()
        await self._stop.wait()
        listening.close()
        others = asyncio.all_tasks() - {asyncio.current_task()}
        for task in others:
            task.cancel()
        await asyncio.gather(*others, return_exceptions=True)

    async def _connected(self, near: asyncio.StreamReader, back: asyncio.StreamWriter) -> None:
        try:
            far, up = await asyncio.open_connection(*self._server)
        except OSError:
            back.close()
            return
        uplink: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue()
        downlink: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue()
        ways = [
            asyncio.ensure_future(self._receive(near, uplink, self._up_bits_per_s, self._wake_s)),
            asyncio.ensure_future(self._receive(far, downlink, None, 0.0)),
            asyncio.ensure_future(self._send(uplink, up)),
            asyncio.ensure_future(self._send(downlink, back)),
        ]
        with suppress(asyncio.CancelledError):
            await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
        for way in ways:
            way.cancel()
        for writer in (up, back):
            writer.close()

    async def _receive(
        self,
        reader: asyncio.StreamReader,
        queue: asyncio.Queue[tuple[float, bytes]],
        bits_per_s: float | None,
        wake_s: float,
    ) -> None:
        clock = self._loop.time
        heard_s = clock()
        with suppress(OSError, asyncio.TimeoutError):
            while chunk := await asyncio.wait_for(reader.read(self.CHUNK_BYTES), self._forgets_s):
                if wake_s and clock() - heard_s > 1.0:
                    await asyncio.sleep(wake_s)
                if bits_per_s:
                    await asyncio.sleep(8 * len(chunk) / bits_per_s)
                heard_s = clock()
                queue.put_nowait((heard_s + self._delay_s, chunk))

    async def _send(
        self, queue: asyncio.Queue[tuple[float, bytes]], writer: asyncio.StreamWriter
    ) -> None:
        with suppress(OSError):
            while True:
                due_s, chunk = await queue.get()
                await asyncio.sleep(max(0.0, due_s - self._loop.time()))
                writer.write(chunk)
                await writer.drain()


@contextmanager
def relayed(
    target: str,
    *,
    up_bits_per_s: float | None = None,
    delay_s: float = 0.0,
    wake_s: float = 0.0,
    forgets_s: float | None = None,
) -> Iterator[str]:
    """A relay while the block runs; gives its address."""
    relay = Relay(
        target, up_bits_per_s=up_bits_per_s, delay_s=delay_s, wake_s=wake_s, forgets_s=forgets_s
    )
    relay.start()
    try:
        yield relay.target
    finally:
        relay.stop()
