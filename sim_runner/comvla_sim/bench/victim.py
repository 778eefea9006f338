"""A server that is killed and brought back, again and again."""

from __future__ import annotations

import threading
import time

from comvla_sim.demo.server_process import ServerProcess, ServerProcessError

_RESTART_WITHIN_S = 120.0


class Victim:
    """A server on ports of its own that is killed and brought back by a thread beside the robot."""

    def __init__(self, model: str) -> None:
        self._model = model
        self._process = ServerProcess(model)
        self._thread: threading.Thread | None = None
        self._trouble: BaseException | None = None
        self._struck = threading.Event()
        self._back = threading.Event()
        self.target = ""
        self.killed_at = 0.0
        self.back_at = 0.0

    @property
    def struck(self) -> bool:
        """Whether the blow has fallen."""
        return self._struck.is_set()

    @property
    def up_again(self) -> bool:
        """Whether it was said to be ready again since."""
        return self._back.is_set()

    def kill_and_restart(self, after_s: float) -> None:
        """Kills the server a moment from now, perhaps in the middle of a call, and starts it again."""
        self._struck.clear()
        self._back.clear()
        self._thread = threading.Thread(target=self._work, args=(after_s,), daemon=True)
        self._thread.start()

    def check(self) -> None:
        """Raises ServerProcessError where the server could not be brought back."""
        if self._trouble is not None:
            raise ServerProcessError(f"the server did not come back: {self._trouble}")

    def _work(self, after_s: float) -> None:
        time.sleep(after_s)
        try:
            self._process.kill()
            self.killed_at = time.monotonic()
            self._struck.set()
            port, admin_port = (int(place.rpartition(":")[2]) for place in self._places)
            self._process = ServerProcess(self._model, port=port, admin_port=admin_port)
            self._process.__enter__()
            self.back_at = time.monotonic()
            self._back.set()
        except BaseException as error:
            self._trouble = error

    def __enter__(self) -> Victim:
        self._process.__enter__()
        self.target = self._process.target
        self._places = (self._process.target, self._process.admin_url)
        return self

    def __exit__(self, *_: object) -> None:
        if self._thread is not None:
            self._thread.join(_RESTART_WITHIN_S)
        self._process.stop()
