"""``comvla-server swap``: has a server that runs replace a model."""

from __future__ import annotations

import argparse
import json
import ssl
import urllib.error
import urllib.parse
import urllib.request
from pathlib import Path
from typing import Any

from comvla.errors import ComVLAError
from comvla.number_arguments import SECONDS
from comvla_server.ports import is_loopback

_DESCRIPTION = """\
Replace a model of a server while robots use it.

  comvla-server swap /models/next --token-file operator.token
  comvla-server swap /models/next --token-file operator.token --check    only say what it takes

The server loads the checkpoint beside the one that serves, warms it up, switches over in one step,
lets calls under way finish on the old one, and frees it. No call fails. Whatever goes wrong leaves the
old one serving. SOURCE is a path on the server's machine.

Robots go on without a word when the new checkpoint is the same model, or has the same edge half. Any
other is refused, because robots could not work with it, unless --new-edge says that they shall stop and
load another edge half.

It takes a token with the right to: `comvla-server token new NAME --may-swap --file ADMIN_TOKENS`.
"""


class SwapRefusedError(ComVLAError):
    """The server did not replace its model, or could not be asked."""


def add_parser(subparsers: Any) -> None:
    """Registers the subcommand."""
    parser = subparsers.add_parser(
        "swap",
        help="replace a model of a running server",
        description=_DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("source", help="the new checkpoint, as for serve --model")
    parser.add_argument("--model", default="", metavar="NAME", help="which model (the default one)")
    parser.add_argument(
        "--admin",
        default="http://127.0.0.1:8080",
        metavar="URL",
        help="the server's admin surface (default: %(default)s)",
    )
    parser.add_argument(
        "--token-file", type=Path, required=True, metavar="FILE", help="holds an operator's token"
    )
    parser.add_argument("--tls-ca", type=Path, metavar="FILE", help="authorities to trust, PEM")
    parser.add_argument(
        "--insecure",
        action="store_true",
        help="send the token in the clear to another machine: whoever is on the way may swap, too",
    )
    parser.add_argument(
        "--new-edge", action="store_true", help="also where robots need another edge half"
    )
    parser.add_argument("--check", action="store_true", help="replace nothing")
    parser.add_argument(
        "--timeout-s", type=SECONDS, default=1800.0, help="longest to wait (default: 1800)"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Asks, waits, and prints what was done.

    Raises:
        SwapRefusedError: nothing was replaced.
    """
    order = {
        "source": args.source,
        "model": args.model,
        "new_edge": args.new_edge,
        "check": args.check,
    }
    report = _report(_post(args, order), args.admin)
    print(json.dumps(report) if args.json else _words(report))
    return 0


def _post(args: argparse.Namespace, order: dict[str, Any]) -> Any:
    _check_address(args.admin, insecure=args.insecure)
    try:
        token = args.token_file.read_text(encoding="ascii").strip()
        trust = None
        if args.admin.startswith("https://"):
            trust = ssl.create_default_context(cafile=args.tls_ca)
    except (OSError, ValueError) as error:
        raise SwapRefusedError(f"cannot read --token-file or --tls-ca: {error}") from error
    request = urllib.request.Request(
        args.admin.rstrip("/") + "/v1/models/swap",
        data=json.dumps(order).encode(),
        headers={"Authorization": f"Bearer {token}", "Content-Type": "application/json"},
    )
    handlers: list[Any] = [urllib.request.ProxyHandler({}), _NoRedirects()]
    if trust is not None:
        handlers.append(urllib.request.HTTPSHandler(context=trust))
    try:
        with urllib.request.build_opener(*handlers).open(request, timeout=args.timeout_s) as answer:
            return json.load(answer)
    except urllib.error.HTTPError as error:
        raise SwapRefusedError(f"nothing was replaced: {_detail(error)}") from error
    except (OSError, ValueError) as error:
        raise SwapRefusedError(
            f"expected the admin surface of a server at {args.admin}, got {error}: correct --admin; "
            "where the answer was lost, GET /v1/models says what serves now"
        ) from error


class _NoRedirects(urllib.request.HTTPRedirectHandler):
    """Takes a redirect for an error: the token is for one address."""

    def redirect_request(self, *_: Any, **__: Any) -> None:
        return None


def _check_address(admin: str, *, insecure: bool) -> None:
    try:
        address = urllib.parse.urlsplit(admin)
        host = address.hostname
    except ValueError:
        host = None
    if not host or address.scheme not in ("http", "https"):
        raise SwapRefusedError(f"expected --admin as http://… or https://…, got {admin!r}")
    if address.scheme == "http" and not insecure and not is_loopback(host):
        raise SwapRefusedError(
            f"{admin} would get the token in the clear: expected https:// beyond this machine; "
            "give --insecure where the network is trusted"
        )


def _report(answer: Any, admin: str) -> dict[str, Any]:
    """An answer that is a report, whole."""
    numbers = ("needed_bytes", "load_s", "warm_up_s", "drain_s")
    if (
        isinstance(answer, dict)
        and all(isinstance(answer.get(name), str) for name in ("before", "after"))
        and answer.get("robots") in _ROBOTS
        and all(isinstance(answer.get(name), (int, float)) for name in numbers)
        and isinstance(answer.get("available_bytes", ""), (int, float, type(None)))
        and all(isinstance(answer.get(name), bool) for name in ("swapped", "freed"))
    ):
        return answer
    raise SwapRefusedError(
        f"expected the report of a swap from {admin}, got {json.dumps(answer)[:200]}: correct "
        "--admin; GET /v1/models says what serves now"
    )


_ROBOTS = {
    "same": "the same model",
    "compatible": "robots go on with the edge half they have",
    "new_edge": "robots need another edge half",
}


def _detail(error: urllib.error.HTTPError) -> str:
    text = error.read(65536).decode(errors="replace").strip()
    try:
        detail = json.loads(text)["detail"]
    except (ValueError, KeyError, TypeError):
        return f"{error.code} {text or error.reason}"
    return detail if isinstance(detail, str) else f"{error.code} {json.dumps(detail)}"


def _words(report: dict[str, Any]) -> str:
    need, there = report["needed_bytes"], report["available_bytes"]
    room = f"{need / 1e6:.0f} MB needed"
    if there is not None:
        room += f", {there / 1e6:.0f} MB available"
    line = f"{report['before']} -> {report['after']}: {_ROBOTS[report['robots']]}; {room}"
    if not report["swapped"]:
        return f"checked only: {line}"
    return (
        f"swapped: {line}\nloaded in {report['load_s']:.1f} s, warm after {report['warm_up_s']:.1f} s, "
        f"old one done after {report['drain_s']:.2f} s"
        + (" and freed" if report["freed"] else ", freed when its last call ends")
    )
