"""``comvla-server ray``: the same service on several replicas, behind Ray Serve's gRPC proxy."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import os
import signal
import socket
import threading
import time
from collections.abc import Callable
from typing import Any

from comvla.errors import ComVLAError, DependencyError
from comvla.number_arguments import number, whole
from comvla_server import logs
from comvla_server.setting_fields import SettingsError
from comvla_server.settings import ServerSettings
from comvla_server.settings_flags import add_flags, settings_of

_DESCRIPTION = """\
Serve a policy on several replicas behind Ray Serve's gRPC proxy, on this machine or on a cluster.

  comvla-server ray --replicas 2 --insecure
  comvla-server ray --replicas 8 --address auto --num-gpus 1 --device cuda --insecure

Takes the options of `serve`. Ray's proxy listens on ALL addresses of every node, without TLS: it says so,
and starts only with --insecure. Keep the port inside a network that you trust, or put a proxy that
speaks TLS in front. Tokens (--tokens-file, a path on every node) are checked by the replicas.

One line on stdout says when robots may call:
  comvla-server ready grpc=127.0.0.1:50051 model=mini replicas=2

A robot's steps go to any replica. SIGTERM or Ctrl-C ends the deployment, and Ray itself where this
command started it.
"""

APPLICATION = "comvla"

_SERVICERS = [
    "comvla.v1.policy_pb2_grpc.add_PolicyServiceServicer_to_server",
    "grpc_health.v1.health_pb2_grpc.add_HealthServicer_to_server",
]
_DEFAULTS = {
    "RAY_USAGE_STATS_ENABLED": "0",  # it would call its makers
    # A busy machine takes longer than 5 s to start a process that imports Ray.
    "RAY_SERVE_PROXY_READY_CHECK_TIMEOUT_S": "120",
}
_OBJECT_STORE_BYTES = 100 * 2**20
_PROXY_WITHIN_S = 120.0
_LOOK_EVERY_S = 0.1
_ELSEWHERE = ("tls_certificate", "tls_key", "tls_client_ca", "admin_tokens_file")


class RayError(ComVLAError):
    """Ray did not do what it was asked to."""


def add_parser(subparsers: Any) -> None:
    """Registers the subcommand."""
    parser = subparsers.add_parser(
        "ray",
        help="serve on several replicas with Ray Serve",
        description=_DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    group = parser.add_argument_group("Ray")
    group.add_argument("--replicas", type=whole(1, 1000), default=2, help="how many (default: 2)")
    group.add_argument(
        "--address", help="of a cluster: auto, or HOST:PORT; default: start Ray on this machine"
    )
    group.add_argument(
        "--num-cpus", type=number(0.0), default=0.0, help="cores that a replica reserves (0)"
    )
    group.add_argument(
        "--num-gpus", type=number(0.0), default=0.0, help="accelerators that it reserves (0)"
    )
    add_flags(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Serves until a signal.

    Raises:
        DependencyError: Ray is not installed.
        SettingsError: settings that Ray's proxy cannot keep.
    """
    settings = settings_of(args).settings
    _check(settings)
    logs.configure(settings.log_format, settings.log_level)
    stop = threading.Event()
    _on_signals(_interrupt)  # Ray takes a while to start
    with (
        contextlib.suppress(KeyboardInterrupt),
        deployed(
            settings,
            replicas=args.replicas,
            address=args.address,
            num_cpus=args.num_cpus,
            num_gpus=args.num_gpus,
        ) as target,
    ):
        _on_signals(lambda *_: stop.set())  # Ray has put handlers of its own there
        names = ",".join(name or source for name, source in settings.models.items())
        print(
            f"comvla-server ready grpc={target} model={names} replicas={args.replicas}", flush=True
        )
        stop.wait()
    return 0


def _interrupt(*_: object) -> None:
    raise KeyboardInterrupt


def _on_signals(handler: Callable[..., None]) -> None:
    for one in (signal.SIGTERM, signal.SIGINT):
        signal.signal(one, handler)


@contextlib.contextmanager
def deployed(
    settings: ServerSettings,
    *,
    replicas: int,
    address: str | None = None,
    num_cpus: float = 0.0,
    num_gpus: float = 0.0,
) -> Any:
    """The deployment while the block lasts.

    Args:
        settings: of every replica; ``port`` is the proxy's, and has to be given.
        replicas: how many.
        address: of a running cluster; None starts Ray here, without a dashboard.
        num_cpus, num_gpus: that one replica reserves.

    Yields:
        Where robots connect on this node, ``host:port``.

    Raises:
        DependencyError: Ray is not installed.
        RayError: replicas or proxy did not come up.
    """
    ray, serve = _ray()
    started = not ray.is_initialized()
    try:
        try:
            if started:
                _join(ray, address)
            _deploy(serve, settings, replicas, num_cpus, num_gpus)
        except Exception as error:  # Ray raises many kinds
            raise RayError(
                f"replicas or proxy did not come up ({type(error).__name__}: {error}): Ray's logs in "
                "/tmp/ray/session_latest/logs say more"
            ) from error
        yield f"127.0.0.1:{settings.port}"
    finally:
        with contextlib.suppress(Exception):  # whatever is left of it ends with Ray
            serve.shutdown()
        if started:
            ray.shutdown()


def _join(ray: Any, address: str | None) -> None:
    options: dict[str, Any] = {"address": address}
    if address is None:
        # "local": another user's Ray on this machine must not be taken for ours.
        options = {
            "address": "local",
            "include_dashboard": False,
            "object_store_memory": _OBJECT_STORE_BYTES,
            "_node_ip_address": "127.0.0.1",
        }
    ray.init(log_to_driver=False, configure_logging=False, **options)


def _deploy(
    serve: Any, settings: ServerSettings, replicas: int, num_cpus: float, num_gpus: float
) -> None:
    from comvla_server.ray_replica import Replica

    serve.start(
        proxy_location="EveryNode",
        http_options={"host": "127.0.0.1", "port": _free_port()},
        grpc_options={
            "port": settings.port,
            "grpc_servicer_functions": _SERVICERS,
            "request_timeout_s": settings.default_deadline_s,
        },
    )
    deployment = serve.deployment(Replica).options(
        num_replicas=replicas,
        max_ongoing_requests=settings.max_queue + settings.max_batch,
        health_check_period_s=1.0,
        graceful_shutdown_timeout_s=settings.grace_s,
        ray_actor_options={
            "num_cpus": num_cpus,
            "num_gpus": num_gpus,
            "runtime_env": {"env_vars": _environment()},
        },
    )
    # Ports and TLS are the proxy's: a replica listens nowhere.
    inner = dataclasses.replace(settings, host="127.0.0.1", insecure=False)
    # Without a prefix, which only HTTP needs, Ray's proxies would not hear of the application.
    serve.run(deployment.bind(inner), name=APPLICATION, route_prefix=f"/{APPLICATION}")
    _wait_for_proxy(settings.port)


def _wait_for_proxy(port: int) -> None:
    """Returns when the proxy hands calls on: it hears of an application a moment after it runs.

    Raises:
        grpc.RpcError: it did not in time.
    """
    import grpc
    from grpc_health.v1 import health_pb2, health_pb2_grpc

    deadline = time.monotonic() + _PROXY_WITHIN_S
    with grpc.insecure_channel(f"127.0.0.1:{port}", [("grpc.enable_http_proxy", 0)]) as channel:
        ask: Any = health_pb2_grpc.HealthStub(channel).Check  # type: ignore[attr-defined]
        while True:
            try:
                ask(health_pb2.HealthCheckRequest(), timeout=_PROXY_WITHIN_S, wait_for_ready=True)
            except grpc.RpcError:
                if time.monotonic() > deadline:
                    raise
                time.sleep(_LOOK_EVERY_S)
            else:
                return


def _ray() -> Any:
    for name, value in _DEFAULTS.items():
        os.environ.setdefault(name, value)
    try:
        import ray
        from ray import serve
    except ImportError as error:
        raise DependencyError(
            "replicas need Ray Serve, which is not installed: pip install 'comvla[ray]'"
        ) from error
    return ray, serve


def _free_port() -> int:
    """For the HTTP proxy that Ray starts, wanted or not, on this machine only; replicas answer it nothing."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        return int(free.getsockname()[1])


def _environment() -> dict[str, str]:
    """Replicas on this machine see what this process sees: where its packages lie, and its threads."""
    kept = ("PYTHONPATH", "OMP_NUM_THREADS")
    return {name: os.environ[name] for name in kept if name in os.environ}


def _check(settings: ServerSettings) -> None:
    given = [name for name in _ELSEWHERE if getattr(settings, name) is not None]
    if given:
        raise SettingsError(
            f"{', '.join(given)} cannot be kept: Ray's proxy has no TLS and there is no admin surface; "
            "put a proxy that speaks TLS in front, or run plain servers and give robots all of them"
        )
    if not settings.insecure:
        raise SettingsError(
            "Ray's gRPC proxy listens on all addresses without TLS, whatever --host says: give "
            "--insecure inside a network that you trust, or run plain servers with TLS and give robots "
            "all of them (host:port,host:port)"
        )
    if settings.port == 0:
        raise SettingsError("port 0 takes a free port, which Ray's proxy cannot: name one")
