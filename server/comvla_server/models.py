"""The models that a server answers with, by name: which one a call means, and who still uses it."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from comvla_server.batcher import Batcher
from comvla_server.decoding import Decoding
from comvla_server.engine import Engine
from comvla_server.model_names import UNNAMED
from comvla_server.refusals import Reason, Refusal
from comvla_server.validation import Validator
from comvla_server.wording import shown


@dataclass(frozen=True, eq=False)
class Runtime:
    """A model that is loaded, warm, and behind its queue.

    Attributes:
        engine: the model.
        batcher: its queue.
        validator: checks requests against it.
        decoding: reads its pictures.
        name: under which robots ask for it.
        users: calls that it has to answer.
    """

    engine: Engine
    batcher: Batcher
    validator: Validator
    decoding: Decoding
    name: str = UNNAMED
    users: Users = field(default_factory=lambda: Users())

    @property
    def label(self) -> str:
        """Its name in metrics and logs."""
        return self.name or "default"


class Users:
    """Counts the calls that hold on to something.

    Attributes:
        none: set while there are none.
    """

    def __init__(self) -> None:
        self.none = asyncio.Event()
        self.none.set()
        self._count = 0

    def __len__(self) -> int:
        return self._count

    @contextmanager
    def one(self) -> Iterator[None]:
        """Around a call."""
        self._count += 1
        self.none.clear()
        try:
            yield
        finally:
            self._count -= 1
            if self._count == 0:
                self.none.set()


class Models:
    """Runtimes by name. Used from one event loop only, so that to replace one is a single step.

    The first is the default: who names no model means it.
    """

    def __init__(self) -> None:
        self._runtimes: dict[str, Runtime] = {}

    def put(self, runtime: Runtime) -> Runtime | None:
        """Answers from now on with this one; the one that had its name before, which may have users."""
        before = self._runtimes.get(runtime.name)
        self._runtimes[runtime.name] = runtime
        return before

    @property
    def default(self) -> Runtime | None:
        """The model that calls mean which name none; None before any is there."""
        return next(iter(self._runtimes.values()), None)

    @property
    def names(self) -> tuple[str, ...]:
        """Names that robots may ask for."""
        return tuple(name for name in self._runtimes if name != UNNAMED)

    def __iter__(self) -> Iterator[Runtime]:
        return iter(tuple(self._runtimes.values()))

    def __len__(self) -> int:
        return len(self._runtimes)

    def find(self, name: str) -> Runtime:
        """The model that a call asks for.

        Raises:
            Refusal: there is none of that name; the message lists those there are.
        """
        runtime = self._runtimes.get(name) if name else self.default
        if runtime is None:
            raise Refusal(
                Reason.UNKNOWN_MODEL,
                f"expected the name of a model that is served here ({self.shown_names()}), got "
                f"{shown(name)}: correct the robot's model=, or start the server with "
                "--model NAME=FOLDER",
            )
        return runtime

    def shown_names(self) -> str:
        """What there is, in words."""
        return ", ".join(self.names) or "one without a name"
