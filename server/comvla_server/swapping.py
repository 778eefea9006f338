"""Replaces a model while robots use it: the new one is loaded and warmed up beside the old one, which
answers until a single step switches over, finishes what it has begun, and is let go.

Whatever goes wrong before that step leaves the old one serving.
"""

from __future__ import annotations

import asyncio
import gc
import logging
import time
import weakref
from collections.abc import Awaitable, Mapping
from dataclasses import replace
from typing import Literal, TypeAlias, TypeVar

from comvla import handshake
from comvla.errors import ComVLAError
from comvla_server.engine import Engine
from comvla_server.inference_thread import InferenceThread
from comvla_server.lifecycle import Lifecycle
from comvla_server.metrics import Metrics
from comvla_server.model_loading import Candidate, Loader
from comvla_server.models import Models, Runtime
from comvla_server.refusals import Refusal
from comvla_server.runtimes import Runtimes
from comvla_server.settings import ServerSettings
from comvla_server.swap_report import SwapReport, compare
from comvla_server.version import server_version
from comvla_server.vision import VisionHalf
from comvla_server.wording import shown

__all__ = ["SwapError", "SwapReport", "Swapper", "Trouble"]

_log = logging.getLogger(__name__)

_T = TypeVar("_T")

Trouble: TypeAlias = Literal["unknown", "busy", "robots", "memory", "checkpoint", "stopping"]
"""Why a model was not replaced."""


class SwapError(ComVLAError):
    """A model that was not replaced; the one there goes on.

    Attributes:
        trouble: the cause.
    """

    def __init__(self, trouble: Trouble, message: str) -> None:
        super().__init__(message)
        self.trouble: Trouble = trouble


class Swapper:
    """Replaces models of one server, one at a time. Used from its event loop only.

    Args:
        models: what answers.
        runtimes: puts engines behind their queues.
        loader: finds and loads checkpoints.
        lifecycle: nothing is replaced unless the server is ready.
        metrics: say which models answer.
        settings: largest batch, and how long to wait for calls under way.
        sources: the checkpoint behind each name.
    """

    def __init__(
        self,
        models: Models,
        runtimes: Runtimes,
        loader: Loader,
        lifecycle: Lifecycle,
        metrics: Metrics,
        settings: ServerSettings,
        sources: Mapping[str, str],
    ) -> None:
        self._models = models
        self._runtimes = runtimes
        self._loader = loader
        self._lifecycle = lifecycle
        self._metrics = metrics
        self._settings = settings
        self.sources = dict(sources)
        self._busy = ""
        self._retiring: set[asyncio.Task[bool]] = set()

    @property
    def busy(self) -> str:
        """What is being done, empty where nothing is."""
        return self._busy

    async def swap(
        self, model: str, source: str, *, new_edge: bool = False, check: bool = False
    ) -> SwapReport:
        """Replaces one model.

        Args:
            model: name of the one to replace; empty for the default.
            source: the new checkpoint.
            new_edge: also one with another edge half than the robots have. They are then told so at
                their next step, and stop.
            check: only say what would happen, and what it takes.

        Raises:
            SwapError: nothing was replaced.
        """
        if self._busy:
            raise SwapError(
                "busy", f"the server is {self._busy}: expected one swap at a time; retry after it"
            )
        self._busy = f"loading {shown(source)}"
        thread = InferenceThread("comvla-load")
        try:
            return await self._swap(thread, self._find(model), source, new_edge, check)
        finally:
            self._busy = ""
            thread.close(timeout_s=0.0)

    async def refresh(self) -> tuple[list[SwapReport], list[SwapError]]:
        """Replaces every model whose checkpoint is another by now; those that are not stay.

        Returns:
            What was replaced, and why others were not: a checkpoint that cannot be used, or that
            robots could not work with, is not in the way of the next.
        """
        reports: list[SwapReport] = []
        troubles: list[SwapError] = []
        for runtime in self._models:
            source = self.sources.get(runtime.name)
            if source is None:
                continue
            try:
                there = await self.swap(runtime.name, source, check=True)
                if there.after != there.before:
                    reports.append(await self.swap(runtime.name, source))
            except SwapError as error:
                troubles.append(error)
        return reports, troubles

    async def close(self) -> None:
        """Waits for nothing any more: replaced models that are still asked refuse who waits."""
        retiring = list(self._retiring)
        for task in retiring:
            task.cancel()
        await asyncio.gather(*retiring, return_exceptions=True)

    def _find(self, model: str) -> Runtime:
        try:
            self._lifecycle.require_ready()
        except Refusal as refusal:
            raise SwapError("stopping", refusal.message) from refusal
        try:
            return self._models.find(model)
        except Refusal as refusal:
            raise SwapError(
                "unknown",
                f"expected the name of a model that is served here ({self._models.shown_names()}), "
                f"got {shown(model)}",
            ) from refusal

    async def _swap(
        self, thread: InferenceThread, old: Runtime, source: str, new_edge: bool, check: bool
    ) -> SwapReport:
        candidate = await _trying(thread.run(self._loader.inspect, source), source)
        report = compare(old, candidate)
        if check:
            return report
        if report.robots == "new_edge" and not new_edge:
            difference = handshake.mismatch(old.engine.info, candidate.info)
            raise SwapError(
                "robots",
                f"robots hold the edge half of {old.engine.info.name} and cannot work with "
                f"{shown(source)}: {difference}. Swap to a checkpoint with the same edge half, or give "
                "new_edge (--new-edge): robots then stop until they have the new edge half",
            )
        there = candidate.available_bytes
        if there is not None and there < candidate.needed_bytes:
            raise SwapError(
                "memory",
                f"{shown(source)} needs {_gigabytes(candidate.needed_bytes)} of memory beside the model "
                f"that serves, {_gigabytes(there)} are available: free memory, use a narrower --dtype, "
                "or start a server of the new model elsewhere and drain this one",
            )
        began = time.monotonic()
        engine = await _trying(thread.run(self._load, source, old.engine), source)
        loaded = time.monotonic()
        self._busy = f"warming up {shown(source)}"
        await _trying(thread.run(engine.warm_up, self._settings.max_batch), source)
        warm = time.monotonic()
        self._find(old.name)  # the server may have begun to stop meanwhile
        self._switch(old, engine, report, candidate)
        self._busy = f"letting {old.label} finish its calls"
        ref = weakref.ref(old.engine)
        retiring = asyncio.ensure_future(self._retire(old))
        del old, engine
        self._retiring.add(retiring)
        retiring.add_done_callback(self._retiring.discard)
        await asyncio.wait([retiring], timeout=self._settings.grace_s)
        done = replace(
            report,
            swapped=True,
            load_s=loaded - began,
            warm_up_s=warm - loaded,
            drain_s=time.monotonic() - warm,
            freed=retiring.done() and _freed(ref),
        )
        _log.info(
            "model %s replaced",
            done.model or "default",
            extra={"before": done.before, "after": done.after},
        )
        return done

    def _load(self, source: str, old: Engine) -> Engine:
        engine = self._loader.load(source)
        self._runtimes.check_message_cap(engine)
        if isinstance(engine.vision, VisionHalf) and old.vision is not None:
            # Decoders know no model, and hold the streams that robots' next pictures build on.
            engine.vision.keep_decoders(old.vision)
        return engine

    def _switch(
        self, old: Runtime, engine: Engine, report: SwapReport, candidate: Candidate
    ) -> None:
        also: frozenset[str] = frozenset()
        if report.robots != "new_edge":
            also = old.validator.also | {report.before}
        runtime = self._runtimes.make(engine, old.name, also - {report.after})
        runtime.batcher.adopt_sessions(old.batcher)
        self._models.put(runtime)
        self.sources[old.name] = candidate.source
        infos = [runtime.engine.info for runtime in self._models]
        if all(info.fingerprint != report.before for info in infos):
            self._metrics.forget_model(old.engine.info, server_version())
        self._metrics.describe_model(engine.info, server_version())

    async def _retire(self, old: Runtime) -> bool:
        try:
            await old.users.none.wait()
        finally:
            await old.batcher.close()
        return True


async def _trying(work: Awaitable[_T], source: str) -> _T:
    """What a step towards the new model gives; whatever it raises leaves the old one serving."""
    try:
        return await work
    except ComVLAError as error:
        raise SwapError("checkpoint", f"{shown(source)}: {error}") from error
    except MemoryError as error:
        raise SwapError("memory", f"{shown(source)} does not fit in memory: free some") from error
    except Exception as error:  # torch and safetensors raise many kinds
        _log.exception("a model could not be made ready")
        raise SwapError(
            "checkpoint",
            f"{shown(source)} could not be made ready ({type(error).__name__}: {error}): the model that "
            "serves goes on; the server's log says more",
        ) from error


def _freed(engine: weakref.ref[Engine]) -> bool:
    """Whether a model is gone; where only cycles hold it, they are cut.

    A server freezes what it has loaded out of garbage collection, which is also why a collection is
    tried only where it is needed: it halts everything for as long as it takes to walk through torch.
    """
    frozen = gc.get_freeze_count() > 0
    if engine() is not None:
        gc.unfreeze()
        gc.collect()
    if frozen:
        gc.freeze()
    return engine() is None


def _gigabytes(nbytes: int) -> str:
    return f"{nbytes / 1e9:.3g} GB"
