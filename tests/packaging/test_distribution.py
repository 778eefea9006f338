"""What an installation contains, and what it asks for."""

from __future__ import annotations

import email.message
import email.parser
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = {
    "comvla": "proto",
    "comvla_vla": "vla",
    "comvla_client": "client",
    "comvla_server": "server",
    "comvla_sim": "sim_runner",
}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> zipfile.ZipFile:
    folder = tmp_path_factory.mktemp("wheel")
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)],
        cwd=ROOT,
        check=True,
        capture_output=True,
    )
    (path,) = folder.glob("*.whl")
    return zipfile.ZipFile(path)


@pytest.fixture(scope="module")
def metadata(wheel: zipfile.ZipFile) -> email.message.Message:
    (name,) = (name for name in wheel.namelist() if name.endswith(".dist-info/METADATA"))
    return email.parser.Parser().parsestr(wheel.read(name).decode())


def test_the_wheel_holds_the_packages_whole_and_nothing_else(wheel: zipfile.ZipFile) -> None:
    on_disk = {
        str(path.relative_to(ROOT / root))
        for package, root in PACKAGES.items()
        for path in (ROOT / root / package).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    in_wheel = {name for name in wheel.namelist() if ".dist-info/" not in name}
    assert in_wheel == on_disk


@pytest.mark.parametrize("package", PACKAGES)
def test_every_package_says_that_it_is_typed(package: str, wheel: zipfile.ZipFile) -> None:
    assert f"{package}/py.typed" in wheel.namelist()


def test_the_base_install_is_what_a_robot_needs_to_talk(metadata: email.message.Message) -> None:
    requirements = metadata.get_all("Requires-Dist") or []
    base = {re.split(r"[<>=!~ ;]", line)[0] for line in requirements if "extra ==" not in line}
    assert base == {"numpy", "grpcio", "protobuf"}


def test_torch_has_an_upper_bound_and_is_an_extra(metadata: email.message.Message) -> None:
    requirements = metadata.get_all("Requires-Dist") or []
    torch = [line for line in requirements if line.startswith("torch")]
    assert torch
    assert all("<" in line and "extra ==" in line for line in torch)


def test_constraints_pin_everything_that_the_extras_ask_for(
    metadata: email.message.Message,
) -> None:
    pinned = set(re.findall(r"^([\w.-]+)==", (ROOT / "constraints.txt").read_text(), re.MULTILINE))
    asked = {
        re.split(r"[<>=!~ ;\[]", line)[0].lower().replace("_", "-")
        for line in metadata.get_all("Requires-Dist") or []
    } - {"comvla"}
    assert asked <= pinned
