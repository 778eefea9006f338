"""TLS on both ports, from files that may be replaced while the server runs."""

from __future__ import annotations

import contextlib
import logging
import os
import ssl
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import grpc

from comvla_server.certificates import CertificateError, read_certificates, read_key
from comvla_server.metrics import Metrics
from comvla_server.secret_files import warn_if_exposed
from comvla_server.settings import ServerSettings

_log = logging.getLogger(__name__)

_SOON_S = 14 * 86400.0


class ServerTls:
    """The server's certificate, its key, and the authorities of robots' certificates.

    New connections use what the files held when they were last read; those that are open go on.

    Args:
        certificate: chain, PEM.
        key: PEM.
        client_ca: authorities whose certificates robots must show, none asked for where None.
        metrics: where the end of the certificates is published.
        clock: seconds since 1970.

    Raises:
        CertificateError: a file that cannot be used.
    """

    def __init__(
        self,
        certificate: Path,
        key: Path,
        client_ca: Path | None,
        metrics: Metrics,
        clock: Callable[[], float] = time.time,
    ) -> None:
        self._certificate, self._key, self._client_ca = certificate, key, client_ca
        self._metrics = metrics
        self._clock = clock
        warn_if_exposed(key, "tls_key")
        self.reload()
        self._served = self._grpc

    @classmethod
    def of(cls, settings: ServerSettings, metrics: Metrics) -> ServerTls | None:
        """What the settings ask for, None where they ask for no TLS."""
        if settings.tls_certificate is None or settings.tls_key is None:
            return None
        return cls(settings.tls_certificate, settings.tls_key, settings.tls_client_ca, metrics)

    @property
    def paths(self) -> tuple[Path, ...]:
        """Files to watch."""
        optional = () if self._client_ca is None else (self._client_ca,)
        return (self._certificate, self._key, *optional)

    def reload(self) -> None:
        """Reads the files again; where one is no good, everything stays as it was.

        Raises:
            CertificateError: a file that cannot be used.
        """
        now_s = self._clock()
        chain = read_certificates(self._certificate, "tls_certificate", now_s)
        key = read_key(self._key, "tls_key", chain, self._certificate)
        ends_s = {"server": chain.not_after_s}
        authorities = None
        if self._client_ca is not None:
            bundle = read_certificates(self._client_ca, "tls_client_ca", now_s)
            authorities, ends_s["client_ca"] = bundle.pem, bundle.not_after_s
        context = _https_context(key, chain.pem)
        self._grpc = grpc.ssl_server_certificate_configuration([(key, chain.pem)], authorities)
        self._https, self._pems = context, (key, chain.pem)
        for name, end_s in ends_s.items():
            self._metrics.certificate_not_after.labels(name).set(end_s)
            if end_s - now_s < _SOON_S:
                _log.warning("the %s certificate ends in %.1f days", name, (end_s - now_s) / 86400)

    def grpc_credentials(self) -> grpc.ServerCredentials:
        """Credentials that offer each new connection the current certificate."""
        return grpc.dynamic_ssl_server_credentials(
            self._grpc,
            self._changed,  # type: ignore[arg-type]  # None is no change, which the stubs don't know
            require_client_authentication=self._client_ca is not None,
        )

    def https_context(self) -> ssl.SSLContext:
        """A context that hands each new connection to the current one."""
        context = _https_context(*self._pems)
        context.sni_callback = self._hand_over
        return context

    def _changed(self) -> grpc.ServerCertificateConfiguration | None:
        # gRPC calls this for every connection, from threads of its own, and takes None for no change.
        current = self._grpc
        if current is self._served:
            return None
        self._served = current
        return current

    def _hand_over(
        self, connection: ssl.SSLObject, name: str | None, context: ssl.SSLContext
    ) -> None:
        connection.context = self._https


def _https_context(key: bytes, chain: bytes) -> ssl.SSLContext:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    # Python takes paths only, and the files may have changed since their content was checked.
    with _as_file(key + b"\n" + chain) as path:
        try:
            context.load_cert_chain(path)
        except ssl.SSLError as error:
            raise CertificateError(
                f"the certificate and its key cannot be used for TLS: {error}; make them anew, e.g. "
                "with the elliptic curve prime256v1"
            ) from error
    return context


@contextlib.contextmanager
def _as_file(content: bytes) -> Iterator[str]:
    """A path under which this process can read the content; in memory where there is such a thing."""
    if sys.platform == "linux":
        descriptor = os.memfd_create("comvla-tls")
        with os.fdopen(descriptor, "wb") as file:
            file.write(content)
            file.flush()
            yield f"/proc/self/fd/{descriptor}"
        return
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "pair.pem"
        path.touch(mode=0o600)
        path.write_bytes(content)
        yield str(path)
