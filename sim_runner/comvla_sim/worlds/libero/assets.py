"""Meshes and textures: where they are, what they are, and how packs of them are unpacked.

Authentic assets come from the hub (``lerobot/libero-assets``). Packs with two suites' files, some
of them plain stand-ins, serve tests where the hub cannot be reached: success rates measured with
them must never be compared with published ones, so every figure carries the label.
"""

from __future__ import annotations

import hashlib
import lzma
import os
import shutil
import tarfile
import tempfile
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from comvla_sim.worlds.libero.errors import AssetsError

AUTHENTIC, STAND_IN = "authentic", "stand-in"

PACKS_VARIABLE = "COMVLA_LIBERO_ASSETS"
"""Environment variable with the folder of the packs, read by ``comvla-sim libero setup``."""

PACKS = ("libero_spatial_assets.tar.xz", "libero_goal_assets.tar.xz")

HUB_REPOSITORY = "lerobot/libero-assets"

_KINDS = ("articulated_objects", "scenes", "stable_scanned_objects", "textures")
_MARKER = "STAND-IN"

# The stand-ins' own files, recognised even where somebody unpacked them by hand.
_STAND_IN_SHA256 = {
    "stable_scanned_objects/akita_black_bowl/texture.png": (
        "59cffa0661fda58b3792da3fc0527145d6dcb90e56fd9d67269cca2a521176a7"
    ),
    "stable_scanned_objects/akita_black_bowl/visual/akita_black_bowl_vis.msh": (
        "d217c60374dbde724b947ba445d066f6c8da0f3a86cc45cc15a7085ff29c5e2c"
    ),
    "stable_scanned_objects/plate/texture.png": (
        "9edf93b15435f710f6ce37585a35c7f55a66faba9c32016d46f4d8199dff3663"
    ),
}

_MAX_FILES = 20_000
_MAX_BYTES = 4 << 30


@dataclass(frozen=True)
class Assets:
    """Assets that can be used.

    Attributes:
        folder: with ``scenes``, ``textures`` and the objects.
        label: ``"authentic"`` or ``"stand-in"``.
    """

    folder: Path
    label: str


def label_of(folder: Path) -> str:
    """Whether a folder holds authentic assets, or any stand-in among them."""
    if (folder / _MARKER).exists():
        return STAND_IN
    for name, digest in _STAND_IN_SHA256.items():
        path = folder / name
        if path.is_file() and hashlib.sha256(path.read_bytes()).hexdigest() == digest:
            return STAND_IN
    return AUTHENTIC


def hub_cache() -> Path:
    """Where LIBERO's own download puts the authentic assets."""
    return Path.home() / ".cache" / "libero" / "assets"


def find_assets(package: Path, unpacked: Path) -> Assets:
    """The assets to use; authentic ones first.

    Args:
        package: ``libero/libero`` in LIBERO's environment, which may bring its own.
        unpacked: where ``comvla-sim libero setup`` unpacks packs.

    Raises:
        AssetsError: there are none; the message says how to get them.
    """
    places = (package / "assets", hub_cache(), unpacked)
    found = [
        Assets(place, label_of(place))
        for place in places
        if all((place / kind).is_dir() for kind in _KINDS)
    ]
    for label in (AUTHENTIC, STAND_IN):
        for assets in found:
            if assets.label == label:
                return assets
    raise AssetsError(
        f"no LIBERO assets in {', '.join(map(str, places))}: run `comvla-sim libero setup "
        f"--download` for the authentic ones ({HUB_REPOSITORY}), or set {PACKS_VARIABLE} to a "
        f"folder with {' or '.join(PACKS)} and run `comvla-sim libero setup`"
    )


def unpack(packs: Path, destination: Path) -> list[str]:
    """Unpacks the packs of a folder into one folder, replacing it whole or not at all.

    Args:
        packs: folder with one or more of :data:`PACKS`.
        destination: the assets folder.

    Returns:
        Names of the packs.

    Raises:
        AssetsError: no pack, a damaged one, or one that wants to write elsewhere.
    """
    present = [packs / name for name in PACKS if (packs / name).is_file()]
    if not present:
        raise AssetsError(
            f"{packs} holds none of {', '.join(PACKS)}: set {PACKS_VARIABLE} to the folder that does"
        )
    destination.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=destination.parent, prefix=".unpacking-") as temporary:
        fresh = Path(temporary) / "assets"
        fresh.mkdir()
        for pack in present:
            _extract(pack, fresh)
        (fresh / _MARKER).write_text(
            "Some of these files are plain stand-ins for the benchmark's own.\n"
            "Never compare success rates measured with them with published ones.\n"
        )
        if destination.exists():
            shutil.rmtree(destination)
        os.replace(fresh, destination)
    return [pack.name for pack in present]


def _extract(pack: Path, folder: Path) -> None:
    """Extracts plain files only; the names decide where, so they are checked before anything."""
    try:
        with tarfile.open(pack, "r:xz") as archive:
            members = archive.getmembers()
            if len(members) > _MAX_FILES or sum(m.size for m in members) > _MAX_BYTES:
                raise AssetsError(f"{pack} is too large to be a pack of assets: get it anew")
            for member in members:
                _check_member(pack, member)
            for member in members:
                target = folder.joinpath(*PurePosixPath(member.name).parts)
                if member.isdir():
                    target.mkdir(parents=True, exist_ok=True)
                    continue
                target.parent.mkdir(parents=True, exist_ok=True)
                source = archive.extractfile(member)
                assert source is not None
                with source, target.open("wb") as sink:
                    shutil.copyfileobj(source, sink)
    except (tarfile.TarError, lzma.LZMAError, EOFError, OSError) as error:
        raise AssetsError(f"cannot unpack {pack} ({error}): get it anew") from error


def _check_member(pack: Path, member: tarfile.TarInfo) -> None:
    path = PurePosixPath(member.name)
    if not (member.isfile() or member.isdir()):
        raise AssetsError(f"{pack} holds {member.name!r}, which is no plain file: get it anew")
    if path.is_absolute() or ".." in path.parts or "\\" in member.name or ":" in member.name:
        raise AssetsError(f"{pack} wants to write {member.name!r} outside its folder: get it anew")
