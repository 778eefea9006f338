"""Settings that are each allowed, and cannot hold together."""

from __future__ import annotations

from typing import TYPE_CHECKING

from comvla_server.model_names import parse_models
from comvla_server.ports import is_loopback
from comvla_server.setting_fields import SettingsError

if TYPE_CHECKING:
    from comvla_server.settings import ServerSettings


def check_together(settings: ServerSettings) -> None:
    """Refuses what contradicts itself, and what would open the server by accident.

    Raises:
        SettingsError: names both settings and the remedy.
    """
    _check_model(settings)
    _check_network(settings)
    _check_tls(settings)
    _check_access(settings)
    _check_traces(settings)
    least = settings.max_queue + settings.max_batch
    if settings.max_sessions < least:
        raise SettingsError(
            f"max_sessions must be a whole number from {least} to 10000000, got "
            f"{settings.max_sessions}: it covers max_queue + max_batch"
        )
    least = 2 * settings.max_request_bytes
    if settings.max_bytes_in_flight < least:
        raise SettingsError(
            f"max_bytes_in_flight must be a whole number from {least} to {2**40}, got "
            f"{settings.max_bytes_in_flight}: it holds one request and its tokens"
        )


def _check_model(settings: ServerSettings) -> None:
    parse_models(settings.model)
    if settings.fastv is not None:
        layer, drop = settings.fastv
        if layer < 1 or not 0 <= drop < 1:
            raise SettingsError(
                f"fastv must be a layer >= 1 and a share below 1, e.g. 3,0.75, got {layer},{drop}"
            )


def _check_network(settings: ServerSettings) -> None:
    for name in ("host", "admin_host"):
        host = getattr(settings, name)
        if host is not None and (not host or any(c.isspace() or not c.isprintable() for c in host)):
            raise SettingsError(f"{name} must be an address such as 127.0.0.1 or ::1, got {host!r}")
    if settings.port and settings.port == settings.admin_port:
        raise SettingsError(
            f"port and admin_port are both {settings.port}: gRPC and HTTP need one each"
        )


def _check_tls(settings: ServerSettings) -> None:
    if (settings.tls_certificate is None) != (settings.tls_key is None):
        given, missing = "tls_certificate", "tls_key"
        if settings.tls_certificate is None:
            given, missing = missing, given
        raise SettingsError(
            f"{given} is given without {missing}: TLS needs a certificate and its key"
        )
    if settings.tls_client_ca is not None and not settings.tls:
        raise SettingsError(
            "tls_client_ca is given without TLS: robots can only show certificates to a server "
            "that has tls_certificate and tls_key"
        )
    if settings.insecure and settings.tls:
        raise SettingsError(
            "insecure and tls_certificate contradict each other: give one of them up"
        )
    for host in (settings.host, settings.admin_address):
        if not (settings.tls or settings.insecure or is_loopback(host)):
            raise SettingsError(
                f"{host} is reached from beyond this machine, and nothing would be encrypted: "
                "give --tls-certificate and --tls-key, or listen on 127.0.0.1 behind a tunnel; "
                "--insecure does without, in a network where nobody listens in"
            )


def _check_access(settings: ServerSettings) -> None:
    for name in ("identity_requests_per_s", "identity_bytes_per_s"):
        if getattr(settings, name) and not settings.authenticates:
            raise SettingsError(
                f"{name} limits each robot, and nothing tells robots apart: give --tokens-file "
                "or --tls-client-ca"
            )
    if settings.open_metrics and settings.admin_tokens_file is None:
        raise SettingsError(
            "open_metrics excepts /metrics from a token, and none is asked for: give "
            "--admin-tokens-file, or leave it out"
        )
    if settings.tokens_file is not None and settings.tokens_file == settings.admin_tokens_file:
        raise SettingsError(
            f"tokens_file and admin_tokens_file are both {settings.tokens_file}: a robot's token "
            "must not open the admin surface, so keep two files"
        )


def _check_traces(settings: ServerSettings) -> None:
    if settings.otel_sample > 1.0:
        raise SettingsError(
            f"otel_sample must be a share from 0 to 1, got {settings.otel_sample:g}"
        )
    endpoint = settings.otel_endpoint
    if endpoint is not None and not endpoint.startswith(("http://", "https://")):
        raise SettingsError(
            f"otel_endpoint must be a collector's OTLP/HTTP address, e.g. "
            f"http://127.0.0.1:4318/v1/traces, got {endpoint!r}"
        )
