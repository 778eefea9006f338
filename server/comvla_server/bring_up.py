"""From functions that load models to models that answer."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TypeAlias

from comvla.model_info import ModelInfo
from comvla_server.engine import Engine
from comvla_server.lifecycle import Lifecycle, Phase
from comvla_server.metrics import Metrics
from comvla_server.models import Models
from comvla_server.runtimes import Runtimes
from comvla_server.settings import ServerSettings
from comvla_server.version import server_version

EngineSource: TypeAlias = "Engine | Callable[[], Engine]"
"""A model, or a function that loads it."""


async def bring_up(
    sources: Mapping[str, EngineSource],
    models: Models,
    runtimes: Runtimes,
    *,
    lifecycle: Lifecycle,
    metrics: Metrics,
    settings: ServerSettings,
) -> ModelInfo:
    """Loads and warms up in the inference thread, then puts each model behind its queue.

    Args:
        sources: models by name, the default first.
        models: where they will answer; nothing is put there when the server was stopped meanwhile.
        runtimes: makes queues.
        lifecycle: told of the warm-up.
        metrics: say which models answer.
        settings: largest batch.

    Returns:
        Description of the default model.

    Raises:
        SettingsError: max_request_bytes cannot hold an unpruned observation of a model.
        Exception: whatever loading or the first forward passes raise.
    """
    engines: dict[str, Engine] = {}
    for name, source in sources.items():
        engine = source if isinstance(source, Engine) else await runtimes.thread.run(source)
        runtimes.check_message_cap(engine)
        engines[name] = engine
    lifecycle.enter(Phase.WARMING)
    for engine in engines.values():
        await runtimes.thread.run(engine.warm_up, settings.max_batch)
    if lifecycle.phase is Phase.WARMING:
        for name, engine in engines.items():
            models.put(runtimes.make(engine, name))
            metrics.describe_model(engine.info, server_version())
        metrics.watch(
            queue_depth=lambda: sum(r.batcher.queue_depth for r in models),
            utilization=lambda: min(1.0, sum(r.batcher.utilization for r in models)),
            sessions=lambda: sum(len(r.batcher.sessions) for r in models),
            offered_load=lambda: sum(r.batcher.offered_load for r in models),
            suggested_tokens=lambda: _least_advice(models),
        )
    return next(iter(engines.values())).info


def _least_advice(models: Models) -> int:
    """The fewest tokens that any model advises; 0 where none does."""
    advised = (runtime.batcher.suggested_tokens for runtime in models)
    return min((tokens for tokens in advised if tokens), default=0)
