"""Puts an engine behind its queue: everything that a model needs before robots may ask for it."""

from __future__ import annotations

from comvla import codec
from comvla_server.batcher import Batcher
from comvla_server.decoding import Decoding
from comvla_server.engine import Engine
from comvla_server.inference_thread import InferenceThread
from comvla_server.load_policy import LoadPolicy
from comvla_server.metrics import Metrics
from comvla_server.model_names import UNNAMED
from comvla_server.models import Runtime
from comvla_server.occupancy import Occupancy
from comvla_server.settings import ServerSettings, SettingsError
from comvla_server.validation import Validator

# Envelope of a request around its payload: identifiers, instruction, proprioception.
_ENVELOPE_BYTES = 16 * 1024


class Runtimes:
    """Makes runtimes that share one inference thread and one thread for pictures.

    Args:
        settings: limits.
        metrics: where their batches are counted.
    """

    def __init__(self, settings: ServerSettings, metrics: Metrics) -> None:
        self._settings = settings
        self._metrics = metrics
        self.thread = InferenceThread()
        self._occupancy = Occupancy()
        self._decode_thread = InferenceThread("comvla-decode")
        self._decoding = Decoding(self._decode_thread, settings.max_queue)

    def make(
        self, engine: Engine, name: str = UNNAMED, also: frozenset[str] = frozenset()
    ) -> Runtime:
        """A queue in front of an engine that is warm; needs a running event loop.

        Args:
            engine: the model.
            name: under which robots ask for it.
            also: fingerprints of other models with the same edge half, whose robots it answers too.
        """
        settings = self._settings
        batcher = Batcher(
            engine,
            max_batch=settings.max_batch,
            max_queue=settings.max_queue,
            max_sessions=settings.max_sessions,
            session_ttl_s=settings.session_ttl_s,
            load=LoadPolicy.of(settings),
            metrics=self._metrics,
            thread=self.thread,
            occupancy=self._occupancy,
        )
        batcher.start()
        validator = Validator(engine, settings.max_request_bytes, also)
        runtime = Runtime(engine, batcher, validator, self._decoding, name)
        self._metrics.watch_model(runtime.label, lambda: batcher.queue_depth)
        return runtime

    def check_message_cap(self, engine: Engine) -> None:
        """Whether the server would read an unpruned observation of a model.

        Raises:
            SettingsError: max_request_bytes is too small for it.
        """
        info = engine.info
        payload_bytes = codec.encoded_bytes(
            info.num_tokens, info.token_dim, "float32", num_towers=len(info.tower_dims)
        )
        needed = payload_bytes + _ENVELOPE_BYTES
        if needed > self._settings.max_request_bytes:
            raise SettingsError(
                f"max_request_bytes is {self._settings.max_request_bytes}, an unpruned float32 "
                f"observation of {info.name} needs {needed}: raise --max-request-bytes"
            )

    def close(self, timeout_s: float) -> None:
        """Ends both threads after their current jobs, or leaves them to those."""
        self.thread.close(timeout_s)
        self._decode_thread.close(timeout_s)
