"""Builds what the Dockerfiles build, without a container engine, and calls it: ``make image-check``.

Each image is a bare Debian made by debootstrap, into which its Dockerfile's installation script
installs. The server then runs as the Dockerfile says (user, environment, entry point) on a root file
system that cannot be written to; the edge image looks at it and sends it an observation; the health
check runs; SIGTERM has to end it cleanly. Needs root, for chroot and mounts.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

from root_file_systems import (
    HERE,
    WORK,
    CheckError,
    bare_debian,
    build,
    collect_wheels,
    container,
    run,
)

USER = 10001
READY_S = 120.0


@dataclass
class Recipe:
    """What a Dockerfile says about running its image."""

    environment: dict[str, str] = field(default_factory=dict)
    user: str = ""
    workdir: str = "/"
    entrypoint: list[str] = field(default_factory=list)
    command: list[str] = field(default_factory=list)
    healthcheck: list[str] = field(default_factory=list)
    stopsignal: str = "SIGTERM"

    @classmethod
    def read(cls, path: Path) -> Recipe:
        """The few instructions that matter here; anything else is install.sh's affair."""
        recipe = cls()
        text = re.sub(r"\\\n\s*", " ", path.read_text())
        for line in text.splitlines():
            word, _, rest = line.partition(" ")
            if word == "ENV":
                recipe.environment |= dict(pair.split("=", 1) for pair in shlex.split(rest))
            elif word == "USER":
                recipe.user = rest
            elif word == "WORKDIR":
                recipe.workdir = rest
            elif word == "ENTRYPOINT":
                recipe.entrypoint = json.loads(rest)
            elif word == "CMD":
                recipe.command = json.loads(rest)
            elif word == "HEALTHCHECK":
                recipe.healthcheck = json.loads(rest[rest.index("CMD") + 3 :])
            elif word == "STOPSIGNAL":
                recipe.stopsignal = rest
        return recipe


def command_in(place: Path, recipe: Recipe, arguments: list[str]) -> list[str]:
    """A command line that runs ``arguments`` in the container as its user."""
    user, _, group = recipe.user.partition(":")
    variables = [f"{name}={value}" for name, value in recipe.environment.items()]
    inside = shlex.join(["cd", recipe.workdir]) + " && exec " + shlex.join(arguments)
    return [
        *("setpriv", "--bounding-set=-all,+sys_chroot,+setuid,+setgid", "--no-new-privs"),
        *("chroot", f"--userspec={user}:{group or user}", "--groups=", str(place)),
        *("/usr/bin/env", "-i", *variables, "/bin/sh", "-c", inside),
    ]


def check(root_server: Path, root_edge: Path, port: int, admin_port: int) -> dict[str, object]:
    """Starts the server image, lets the edge image call it, and stops it."""
    server = Recipe.read(HERE / "server.Dockerfile")
    edge = Recipe.read(HERE / "edge.Dockerfile")
    server.environment |= {"COMVLA_PORT": str(port), "COMVLA_ADMIN_PORT": str(admin_port)}
    if server.user.split(":")[0] != str(USER) or edge.user.split(":")[0] != str(USER):
        raise CheckError(f"expected both images to run as user {USER}")
    results: dict[str, object] = {}
    with (
        container(root_server) as server_at,
        container(root_edge) as edge_at,
        contextlib.ExitStack() as logs,
    ):
        refused = subprocess.run(
            command_in(server_at, server, [*server.entrypoint, *server.command]),
            text=True,
            capture_output=True,
            timeout=READY_S,
        )
        if refused.returncode != 2 or "--insecure" not in refused.stderr:
            raise CheckError(
                "expected the image to refuse to serve without TLS (exit code 2), got "
                f"{refused.returncode}: {refused.stderr[-2000:]}"
            )
        results["refuses_without_tls"] = True
        log = logs.enter_context(tempfile.TemporaryFile("w+"))
        started = time.monotonic()
        process = subprocess.Popen(
            command_in(server_at, server, [*server.entrypoint, *server.command, "--insecure"]),
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
        )
        try:
            wait_until_ready(process, server_at, server, log)
            results["start_s"] = round(time.monotonic() - started, 2)
            target = f"127.0.0.1:{port}"
            step = run(
                *command_in(
                    edge_at,
                    edge,
                    [*edge.entrypoint, "step", target, "--json", "--deadline-s", "30"],
                )
            )
            answer = json.loads(step.stdout)
            if answer["report"]["source"] != "cloud" or len(answer["actions"]) < 1:
                raise CheckError(f"expected actions from the cloud, got {step.stdout}")
            results["actions"] = [len(answer["actions"]), len(answer["actions"][0])]
            results["tokens"] = answer["report"]["tokens"]
            process.send_signal(getattr(signal, server.stopsignal))
            results["exit_code"] = process.wait(timeout=30)
            if results["exit_code"] != 0:
                raise CheckError(f"expected exit code 0 after {server.stopsignal}, got {results}")
        except CheckError as error:
            log.seek(0)
            raise CheckError(f"{error}\nThe server said:\n{log.read()[-4000:]}") from None
        finally:
            process.kill()
            process.wait()
    return results


def wait_until_ready(
    process: subprocess.Popen[str], place: Path, recipe: Recipe, log: object
) -> None:
    """Returns when the image's own health check says so."""
    deadline = time.monotonic() + READY_S
    while True:
        healthy = subprocess.run(
            command_in(place, recipe, recipe.healthcheck), text=True, capture_output=True
        )
        if healthy.returncode == 0:
            return
        if process.poll() is not None:
            raise CheckError(f"the server ended with {process.returncode} before it was ready")
        if time.monotonic() > deadline:
            raise CheckError(f"not healthy after {READY_S:g} s: {healthy.stderr}")
        time.sleep(0.2)


def size_mb(root: Path) -> dict[str, float]:
    """What an image takes, in MB: all of it, the environment, and torch alone."""
    places = {"total": root, "environment": root / "opt" / "comvla"}
    places["torch"] = next(root.glob("opt/comvla/lib/python*/site-packages/torch"), root / "none")
    return {
        name: round(int(run("du", "-sx", "--block-size=1000", path).stdout.split()[0]) / 1000, 1)
        for name, path in places.items()
        if path.exists()
    }


def main() -> int:
    """0 when both images are sound."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n\n")[2])
    parser.add_argument("--port", type=int, default=51051, help="of the server (51051)")
    parser.add_argument(
        "--admin-port", type=int, default=51080, help="of its admin surface (51080)"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    args = parser.parse_args()
    if os.geteuid() != 0:
        print(
            "image-check: needs root for chroot and mounts: sudo make image-check", file=sys.stderr
        )
        return 2
    try:
        WORK.mkdir(parents=True, exist_ok=True)
        shutil.rmtree(WORK / "source", ignore_errors=True)
        archive = bare_debian()
        wheels = collect_wheels(["server", "images", "edge"])
        server, edge = (build(image, archive, wheels) for image in ("server", "edge"))
        report = check(server, edge, args.port, args.admin_port)
        report["size_mb"] = {"server": size_mb(server), "edge": size_mb(edge)}
    except CheckError as error:
        print(f"image-check: {error}", file=sys.stderr)
        return 1
    if args.json:
        print(json.dumps(report))
    else:
        print(f"server: ready after {report['start_s']} s, answered {report['actions']} actions")
        for image, sizes in report["size_mb"].items():  # type: ignore[attr-defined]
            print(f"{image}: {', '.join(f'{name} {mb:g} MB' for name, mb in sizes.items())}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
