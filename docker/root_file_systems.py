"""Root file systems of the images, made by debootstrap and install.sh instead of a container engine."""

from __future__ import annotations

import contextlib
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

HERE = Path(__file__).resolve().parent
SOURCE = HERE.parent
WORK = SOURCE / "build" / "image-check"
SUITE = "bookworm"
DEBIAN_PYTHON = (3, 11)


class CheckError(Exception):
    """What is wrong, and what to do."""


def say(text: str) -> None:
    """Progress, on stderr."""
    print(f"image-check: {text}", file=sys.stderr, flush=True)


def run(*command: str | Path, **options: object) -> subprocess.CompletedProcess[str]:
    """A command that has to succeed; its output is shown where it does not."""
    done = subprocess.run(  # type: ignore[call-overload]
        [str(part) for part in command], text=True, capture_output=True, **options
    )
    if done.returncode:
        raise CheckError(
            f"{shlex.join(str(part) for part in command)} failed with {done.returncode}:\n"
            f"{done.stdout[-4000:]}{done.stderr[-4000:]}"
        )
    return done


def mirror() -> str:
    """Where this machine's own Debian packages come from; empty lets debootstrap decide."""
    done = subprocess.run(
        ["apt-get", "indextargets", "--format", "$(REPO_URI)", "Created-By: Packages"],
        text=True,
        capture_output=True,
    )
    places = [line for line in done.stdout.split() if line.rstrip("/").endswith("/debian")]
    return places[0] if places else ""


def bare_debian() -> Path:
    """An archive of a fresh Debian, made once."""
    archive = WORK / f"{SUITE}.tar"
    if archive.exists():
        return archive
    if shutil.which("debootstrap") is None:
        raise CheckError("debootstrap is missing; type: sudo apt-get install debootstrap")
    say(f"making a bare Debian {SUITE} (minutes, once)")
    root = WORK / "bare"
    shutil.rmtree(root, ignore_errors=True)
    place = [mirror()] if mirror() else []
    run("debootstrap", "--variant=minbase", SUITE, root, *place)
    run("tar", "-C", root, "-cf", archive.with_suffix(".part"), ".")
    archive.with_suffix(".part").rename(archive)
    shutil.rmtree(root)
    return archive


def collect_wheels(images: list[str]) -> Path | None:
    """Wheels for the images, found the way pip is set up on this machine; None leaves it to the image."""
    if sys.version_info[:2] != DEBIAN_PYTHON:
        say("this Python differs from Debian's: the images use the package index themselves")
        return None
    folder = WORK / "wheels"
    folder.mkdir(parents=True, exist_ok=True)
    say("collecting wheels")
    index = os.environ.get("TORCH_INDEX_URL")
    extra = ["--extra-index-url", index] if index else []
    wanted = [f"{SOURCE}[{','.join(images)}]", "hatchling"]
    run(
        *(sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check"),
        *("--constraint", SOURCE / "constraints.txt", "--dest", folder, *extra, *wanted),
    )
    return folder


@contextlib.contextmanager
def mounted(*arguments: str | Path) -> Iterator[None]:
    """A mount for as long as it is needed; its last argument is the place."""
    place = Path(arguments[-1])
    place.mkdir(parents=True, exist_ok=True)
    run("mount", *arguments)
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", str(place)], check=False)


def build(image: str, archive: Path, wheels: Path | None) -> Path:
    """The root file system of an image."""
    root = WORK / image
    shutil.rmtree(root, ignore_errors=True)
    root.mkdir(parents=True)
    run("tar", "-C", root, "-xf", archive)
    shutil.copy("/etc/resolv.conf", root / "etc" / "resolv.conf")
    say(f"installing {image}")
    with contextlib.ExitStack() as stack:
        stack.enter_context(mounted("-t", "proc", "proc", root / "proc"))
        stack.enter_context(mounted("--bind", source_copy(), root / "src"))
        script = ["/src/docker/install.sh", image, "/src"]
        if wheels is not None:
            stack.enter_context(mounted("--bind", "-o", "ro", wheels, root / "wheels"))
            script.append("/wheels")
        run("chroot", root, *script, env={"PATH": "/usr/sbin:/usr/bin:/sbin:/bin", "HOME": "/root"})
    for place in ("src", "wheels"):
        with contextlib.suppress(OSError):
            (root / place).rmdir()
    return root


def source_copy() -> Path:
    """What .dockerignore lets into the build: the tracked files of this working copy."""
    copy = WORK / "source"
    if not copy.exists():
        listed = run("git", "-C", SOURCE, "ls-files", "-co", "--exclude-standard", "-z").stdout
        for name in filter(None, listed.split("\0")):
            if (SOURCE / name).is_file():
                (copy / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(SOURCE / name, copy / name)
    return copy


@contextlib.contextmanager
def container(root: Path) -> Iterator[Path]:
    """The image as a container would see it: nothing can be written but /tmp."""
    place = WORK / f"{root.name}-running"
    with contextlib.ExitStack() as stack:
        stack.enter_context(mounted("--bind", root, place))
        run("mount", "-o", "remount,ro,bind", place)
        stack.enter_context(mounted("-t", "proc", "proc", place / "proc"))
        stack.enter_context(
            mounted("-t", "tmpfs", "-o", "size=64m,mode=1777", "tmpfs", place / "tmp")
        )
        stack.enter_context(mounted("--rbind", "/dev", place / "dev"))
        yield place
