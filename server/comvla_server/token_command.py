"""``comvla-server token``: make, list and revoke bearer tokens."""

from __future__ import annotations

import argparse
import fcntl
import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from comvla.number_arguments import number, whole
from comvla_server.identity import IDENTITY_PATTERN, MAY_SWAP, Identity, Limits
from comvla_server.tokens import TokenLine, TokensError, new_token, read_lines

_DESCRIPTION = """\
Bearer tokens of robots (--tokens-file of `serve`) and of operators (--admin-tokens-file).

  comvla-server token new arm-7 --file tokens > arm-7.token   a secret for the robot arm-7
  comvla-server token list --file tokens                      who has one
  comvla-server token revoke arm-7 --file tokens              takes all of arm-7's away

The file holds hashes only: the secret is printed once, and cannot be read again. A server that runs
takes changes over by itself. To renew a token, make a new one, hand it over, then revoke the old
line; one identity may have several.
"""


def add_parser(subparsers: Any) -> None:
    """Registers the subcommand."""
    parser = subparsers.add_parser(
        "token",
        help="make, list and revoke tokens of robots and operators",
        description=_DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    new = actions.add_parser("new", help="make a token, print it once, keep its hash")
    new.add_argument("identity", help="name of the robot or operator")
    for name, words in (
        ("--requests-per-s", "calls that it may make"),
        ("--bytes-per-s", "bytes that it may send"),
        ("--max-request-bytes", "largest request that it may send"),
    ):
        counts = name == "--max-request-bytes"
        new.add_argument(name, type=whole() if counts else number(), metavar="N", help=words)
    new.add_argument(
        "--may-swap",
        action="store_true",
        help="an operator who may replace models (comvla-server swap)",
    )
    listing = actions.add_parser("list", help="print identities and the beginnings of hashes")
    revoke = actions.add_parser("revoke", help="take tokens away")
    revoke.add_argument("identity", help="name of the robot or operator")
    revoke.add_argument(
        "--digest", metavar="HEX", help="only the token whose hash begins so, as `list` shows it"
    )
    for action, run in ((new, _new), (listing, _list), (revoke, _revoke)):
        action.add_argument(
            "--file", type=Path, required=True, metavar="FILE", help="the tokens file"
        )
        action.set_defaults(run=run)


def _new(args: argparse.Namespace) -> int:
    """Raises TokensError: no such identity can be, or the file is not one of tokens."""
    if not IDENTITY_PATTERN.fullmatch(args.identity):
        raise TokensError(
            "expected an identity of up to 100 letters, digits or ._:@/+- that begins with a letter "
            f"or digit, got {args.identity!r}"
        )
    for name in ("requests_per_s", "bytes_per_s", "max_request_bytes"):
        value = getattr(args, name)
        if value is not None and not 0 < value < float("inf"):
            raise TokensError(f"expected {name} as a finite number above 0, got {value}")
    limits = Limits(args.requests_per_s, args.bytes_per_s, args.max_request_bytes)
    identity = Identity(args.identity, limits, frozenset([MAY_SWAP] if args.may_swap else []))
    token = new_token()
    with _alone(args.file):
        _append(args.file, TokenLine.of(identity, token))
    print(token)
    print(
        f"comvla-server: {args.identity} was added to {args.file}; this token is shown only now",
        file=sys.stderr,
    )
    return 0


def _append(path: Path, added: TokenLine) -> None:
    text = path.read_text() if path.exists() else ""
    known = read_lines(path, "--file") if text.strip() else []
    identity = added.identity
    for line in known:
        if line.identity.name == identity.name and line.identity != identity:
            raise TokensError(
                f"{identity.name} is in {path} with other limits or rights: give the same, or revoke "
                "its tokens first"
            )
    if text and not text.endswith("\n"):
        text += "\n"
    _write(path, f"{text}{added}\n")


def _list(args: argparse.Namespace) -> int:
    for line in read_lines(args.file, "--file"):
        name, _, limits = (
            str(line).replace(line.digest.hex(), line.digest.hex()[:12]).partition(" ")
        )
        print(f"{name:24} {limits}")
    return 0


def _revoke(args: argparse.Namespace) -> int:
    """Raises TokensError: nobody of that name has a token, or it would leave the file without any."""
    with _alone(args.file):
        removed = _remove(args)
    print(f"comvla-server: {removed} of {args.identity} revoked in {args.file}", file=sys.stderr)
    return 0


def _remove(args: argparse.Namespace) -> int:
    kept, removed = [], 0
    left = len(read_lines(args.file, "--file"))
    for text in args.file.read_text().splitlines(keepends=True):
        words = text.partition("#")[0].split()
        start = f"sha256:{args.digest or ''}".lower()
        if words and words[0] == args.identity and words[1].startswith(start):
            removed += 1
        else:
            kept.append(text)
    if not removed:
        raise TokensError(
            f"{args.file} holds no such token of {args.identity}: `comvla-server token list` shows "
            "what it holds"
        )
    if removed == left:
        raise TokensError(
            f"that would leave {args.file} without any token, which a server does not accept: make "
            "another first, or stop the server and delete the file"
        )
    _write(args.file, "".join(kept))
    return removed


@contextmanager
def _alone(path: Path) -> Iterator[None]:
    """Nobody else changes the file meanwhile.

    The folder is locked and not the file, which is replaced by each change.
    """
    try:
        folder = os.open(path.absolute().parent, os.O_RDONLY | os.O_DIRECTORY)
    except OSError as error:
        raise _unwritable(path, error) from error
    try:
        fcntl.flock(folder, fcntl.LOCK_EX)
        yield
    finally:
        os.close(folder)


def _unwritable(path: Path, error: OSError) -> TokensError:
    return TokensError(f"cannot write {path}: {error.strerror or error}; choose another --file")


def _write(path: Path, text: str) -> None:
    """Replaces the file in one step: a server that looks meanwhile sees the old or the new one."""
    try:
        before = path.stat() if path.exists() else None
        descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        try:
            with os.fdopen(descriptor, "w") as file:
                file.write(text)
                file.flush()
                os.fsync(file.fileno())
            if before is not None:
                # The server that reads it may be another user than the one who edits it.
                os.chown(temporary, before.st_uid, before.st_gid)
            os.chmod(temporary, 0o600 if before is None else before.st_mode & 0o777)
            os.replace(temporary, path)
        except BaseException:
            os.unlink(temporary)
            raise
    except OSError as error:
        raise _unwritable(path, error) from error
