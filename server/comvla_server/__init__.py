"""The cloud half as a service.

Layers, each of which imports only those before it:

* :mod:`comvla_server.engine`: a plain class around the cloud half, no queue, no network.
* :mod:`comvla_server.batcher`: bounded queue, deadlines, latest observation wins, one thread.
* :mod:`comvla_server.service`: validation and status codes of ``comvla.v1.PolicyService``.
* adapters: :mod:`comvla_server.server` (grpc.aio and the admin surface in one process),
  :mod:`comvla_server.background` (the same in a thread, for tests and notebooks),
  :mod:`comvla_server.cli`.
"""
