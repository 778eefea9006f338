"""Calls that failed because robot and server do not trust each other, told from all others."""

from __future__ import annotations

from comvla_client.errors import TransportError


def locked_out(error: TransportError) -> str | None:
    """Why the server did not let this robot in, or the robot did not trust the server.

    Args:
        error: how a call ended.

    Returns:
        Words with a remedy; None where the call ended for another reason.
    """
    if error.code == "UNAUTHENTICATED":
        return "the server does not know who calls: give it a token that it knows (token=, --token-file)."
    if error.code == "PERMISSION_DENIED":
        return "the server does not allow this to the token that was sent."
    if "certificate has expired" in error.message:
        return "its certificate has expired: renew it, or set this robot's clock."
    if "CERTIFICATE_VERIFY_FAILED" in error.message:
        return (
            "its certificate was made by an authority that this robot does not trust: give the right "
            "one (TlsOptions.ca, --tls-ca)."
        )
    if "Hostname Verification Check failed" in error.message:
        return (
            "its certificate is for another name: call it by that name, or give the name "
            "(TlsOptions.server_name, --tls-server-name)."
        )
    if "WRONG_VERSION_NUMBER" in error.message:
        return "it speaks no TLS: leave the TLS options out, or turn TLS on there."
    return None
