"""Bearer tokens: a file of their hashes, and whose they are.

A line of the file is ``IDENTITY sha256:HEX`` and perhaps limits: ``requests_per_s=20
bytes_per_s=2e6 max_request_bytes=300000``, or for operators the right ``may_swap``. Tokens are 256
random bits, so a plain hash of one tells nothing, and a stolen file opens nothing.
"""

from __future__ import annotations

import hashlib
import hmac
import math
import re
import secrets
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from comvla_server.identity import IDENTITY_PATTERN, RIGHTS, Identity, Limits
from comvla_server.secret_files import read_text
from comvla_server.setting_fields import SettingsError

PREFIX = "cvt_"

_DIGEST = re.compile(r"sha256:([0-9a-f]{64})")
_LOOKS_SECRET = re.compile(PREFIX + r"[A-Za-z0-9_-]+")
_MOST_TOKEN_CHARS = 512
_LIMITS = ("requests_per_s", "bytes_per_s", "max_request_bytes")


class TokensError(SettingsError):
    """A tokens file that cannot be read, or a line of it that makes no sense."""


def new_token() -> str:
    """A fresh secret: 256 random bits, with a prefix by which scanners and people know it."""
    return PREFIX + secrets.token_urlsafe(32)


def masked(text: str) -> str:
    """The text with whatever looks like a token taken out."""
    return _LOOKS_SECRET.sub(PREFIX + "…", text)


@dataclass(frozen=True)
class TokenLine:
    """One line of a tokens file.

    Attributes:
        identity: whose token it is, and its limits.
        digest: sha256 of the token, 32 bytes.
    """

    identity: Identity
    digest: bytes

    @classmethod
    def of(cls, identity: Identity, token: str) -> TokenLine:
        """The line for a token."""
        return cls(identity, hashlib.sha256(token.encode()).digest())

    def __str__(self) -> str:
        given = [(name, getattr(self.identity.limits, name)) for name in _LIMITS]
        limits = "".join(f" {name}={value!r}" for name, value in given if value is not None)
        rights = "".join(f" {right}" for right in sorted(self.identity.rights))
        return f"{self.identity.name} sha256:{self.digest.hex()}{limits}{rights}"


class TokenTable:
    """Tokens by their hashes.

    A look-up takes one step whatever the number of tokens, and its time says nothing about the
    hashes in the file: the table is keyed with a random key of this process.

    Args:
        lines: what is known.
    """

    def __init__(self, lines: Iterable[TokenLine] = ()) -> None:
        self._key = secrets.token_bytes(32)
        self._lines = {self._keyed(line.digest): line for line in lines}

    def __len__(self) -> int:
        return len(self._lines)

    def find(self, token: str) -> Identity | None:
        """Whose token it is, None where it is nobody's."""
        if len(token) > _MOST_TOKEN_CHARS:
            return None
        digest = hashlib.sha256(token.encode(errors="surrogatepass")).digest()
        line = self._lines.get(self._keyed(digest))
        if line is None or not hmac.compare_digest(line.digest, digest):
            return None
        return line.identity

    def _keyed(self, digest: bytes) -> bytes:
        return hashlib.blake2b(digest, key=self._key, digest_size=32).digest()


class TokenFile:
    """A tokens file that may change while the server runs.

    Args:
        path: the file.
        option: the setting that names it, for messages.

    Raises:
        TokensError: unreadable, or a line that makes no sense.
    """

    def __init__(self, path: Path, option: str) -> None:
        self.path = path
        self.option = option
        self._table = TokenTable()
        self.reload()

    @property
    def paths(self) -> tuple[Path, ...]:
        """Files to watch."""
        return (self.path,)

    def __len__(self) -> int:
        return len(self._table)

    def reload(self) -> None:
        """Reads the file again; where it is no good, what was known before stays.

        Raises:
            TokensError: unreadable, or a line that makes no sense.
        """
        self._table = TokenTable(read_lines(self.path, self.option))

    def find(self, token: str) -> Identity | None:
        """Whose token it is, None where it is nobody's."""
        return self._table.find(token)


def read_lines(path: Path, option: str) -> list[TokenLine]:
    """The lines of a tokens file.

    Raises:
        TokensError: unreadable, no token in it, or a line that makes no sense; the message never
            holds the line, which might be a secret.
    """
    lines: list[TokenLine] = []
    known: dict[str, Identity] = {}
    for number, text in enumerate(read_text(path, option, TokensError).splitlines(), 1):
        words = text.partition("#")[0].split()
        if not words:
            continue
        line = _parse(words, f"{path}, line {number}")
        name = line.identity.name
        if known.setdefault(name, line.identity) != line.identity:
            raise TokensError(
                f"{path}, line {number}: {name} has other limits or rights than on a line before; "
                "all tokens of one identity share them"
            )
        lines.append(line)
    if not lines:
        raise TokensError(
            f"{path} holds no token, so nobody could call: add one with `comvla-server token new`"
        )
    return lines


def _parse(words: list[str], where: str) -> TokenLine:
    name, digest = words[0], _DIGEST.fullmatch(words[1]) if len(words) > 1 else None
    if not IDENTITY_PATTERN.fullmatch(name) or digest is None:
        raise TokensError(
            f"{where}: expected IDENTITY sha256:HEX and perhaps limits, got something else; "
            "`comvla-server token new` writes such lines"
        )
    given: dict[str, float] = {}
    rights = frozenset(words[2:]) & frozenset(RIGHTS)
    for word in words[2:]:
        if word in rights:
            continue
        limit, _, value = word.partition("=")
        if limit not in _LIMITS or limit in given:
            raise TokensError(f"{where}: expected limits {', '.join(_LIMITS)}, each at most once")
        try:
            number = float(value)
        except ValueError:
            number = math.nan
        if not (math.isfinite(number) and number > 0):
            raise TokensError(f"{where}: expected {limit} as a finite number above 0")
        given[limit] = number
    largest = given.pop("max_request_bytes", None)
    limits = Limits(**given, max_request_bytes=None if largest is None else int(largest))
    return TokenLine(Identity(name, limits, rights), bytes.fromhex(digest[1]))
