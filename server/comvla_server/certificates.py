"""Certificates and keys, read and checked before anything listens with them."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path

from cryptography import x509
from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    PublicFormat,
    load_pem_private_key,
)

from comvla_server.secret_files import read_bytes
from comvla_server.setting_fields import SettingsError


class CertificateError(SettingsError):
    """A certificate or key that cannot be used; the message names the file and the remedy."""


@dataclass(frozen=True)
class Certificates:
    """A file of certificates that are good now.

    Attributes:
        pem: its content.
        not_after_s: when the first of them expires, seconds since 1970.
        public_key: of the first certificate, DER.
    """

    pem: bytes
    not_after_s: float
    public_key: bytes


def read_certificates(path: Path, option: str, now_s: float) -> Certificates:
    """Reads a chain, or a bundle of authorities.

    Args:
        path: PEM file.
        option: the setting that names it, for messages.
        now_s: seconds since 1970.

    Raises:
        CertificateError: unreadable, no certificate in it, expired, or not valid yet.
    """
    pem = read_bytes(path, option, CertificateError)
    try:
        found = x509.load_pem_x509_certificates(pem)
        key = found[0].public_key().public_bytes(Encoding.DER, PublicFormat.SubjectPublicKeyInfo)
    except (ValueError, UnsupportedAlgorithm, IndexError) as error:
        raise CertificateError(
            f"{path} ({option}) holds no certificate in PEM form: it should begin with "
            "-----BEGIN CERTIFICATE-----"
        ) from error
    for certificate in found:
        _check_dates(certificate, path, option, now_s)
    ends_s = min(certificate.not_valid_after_utc.timestamp() for certificate in found)
    return Certificates(pem, ends_s, key)


def read_key(path: Path, option: str, certificates: Certificates, certificate_path: Path) -> bytes:
    """Reads the private key of a chain.

    Args:
        path: PEM file.
        option: the setting that names it, for messages.
        certificates: the chain whose first certificate the key belongs to.
        certificate_path: where that came from, for messages.

    Raises:
        CertificateError: unreadable, no key, an encrypted one, or the key of another certificate.
    """
    pem = read_bytes(path, option, CertificateError)
    try:
        key = load_pem_private_key(pem, password=None)
    except TypeError as error:
        raise CertificateError(
            f"{path} ({option}) is encrypted, and nobody is there to type its password: decrypt it "
            "with `openssl pkey`, and let only the server's user read it"
        ) from error
    except (ValueError, UnsupportedAlgorithm) as error:
        raise CertificateError(
            f"{path} ({option}) holds no private key in PEM form: it should begin with "
            "-----BEGIN PRIVATE KEY-----"
        ) from error
    public = key.public_key().public_bytes(Encoding.DER, PublicFormat.SubjectPublicKeyInfo)
    if public != certificates.public_key:
        raise CertificateError(
            f"the key {path} does not belong to the certificate {certificate_path}: give the two "
            "that were made together, the server's own certificate first in its file"
        )
    return pem


def _check_dates(certificate: x509.Certificate, path: Path, option: str, now_s: float) -> None:
    name = certificate.subject.rfc4514_string()
    begins, ends = certificate.not_valid_before_utc, certificate.not_valid_after_utc
    now = datetime.fromtimestamp(now_s, tz=timezone.utc)
    if now > ends:
        raise CertificateError(
            f"{path} ({option}): the certificate {name} expired on {ends:%Y-%m-%d %H:%M} UTC: "
            "renew it, or set this machine's clock"
        )
    if now < begins:
        raise CertificateError(
            f"{path} ({option}): the certificate {name} is valid only from "
            f"{begins:%Y-%m-%d %H:%M} UTC: set this machine's clock, or wait"
        )
