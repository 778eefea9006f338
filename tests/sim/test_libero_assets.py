"""Assets: packs are unpacked safely, stand-ins are recognised, authentic ones go first."""

from __future__ import annotations

import io
import tarfile
from pathlib import Path

import pytest

from comvla_sim.worlds.libero import assets
from comvla_sim.worlds.libero.assets import (
    AUTHENTIC,
    PACKS,
    STAND_IN,
    Assets,
    find_assets,
    label_of,
    unpack,
)
from comvla_sim.worlds.libero.errors import AssetsError

FILES = (
    "scenes/table.xml",
    "textures/wood.png",
    "articulated_objects/stove.xml",
    "stable_scanned_objects/plate/plate.xml",
)


def member(name: str, content: bytes = b"x", kind: bytes = tarfile.REGTYPE) -> tarfile.TarInfo:
    info = tarfile.TarInfo(name)
    info.type, info.size, info.linkname = kind, len(content), "/etc/passwd"
    return info


def write_pack(folder: Path, *members: tarfile.TarInfo, name: str = PACKS[0]) -> Path:
    folder.mkdir(exist_ok=True)
    with tarfile.open(folder / name, "w:xz") as archive:
        for info in members:
            archive.addfile(info, io.BytesIO(b"x" * info.size))
    return folder


def fill(folder: Path) -> Path:
    for name in FILES:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"x")
    return folder


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A home without a hub's cache in it."""
    monkeypatch.setattr(Path, "home", lambda: tmp_path / "home")
    return tmp_path / "home"


def test_both_packs_go_into_one_folder_that_says_what_it_is(tmp_path: Path) -> None:
    packs = write_pack(tmp_path / "packs", *map(member, FILES[:3]))
    write_pack(packs, member(FILES[3]), member(FILES[0]), name=PACKS[1])
    target = tmp_path / "env" / "assets"
    assert unpack(packs, target) == list(PACKS)
    assert all((target / name).read_bytes() == b"x" for name in FILES)
    assert find_assets(tmp_path / "package", target) == Assets(target, STAND_IN)


def test_unpacking_again_replaces_what_was_there(tmp_path: Path) -> None:
    packs = write_pack(tmp_path / "packs", *map(member, FILES))
    target = fill(tmp_path / "assets")
    (target / "old.txt").write_text("left over")
    unpack(packs, target)
    assert not (target / "old.txt").exists()
    assert {path.name for path in tmp_path.iterdir()} == {"packs", "assets"}


@pytest.mark.parametrize(
    "evil",
    [
        member("../outside.txt"),
        member("scenes/../../outside.txt"),
        member("/tmp/outside.txt"),
        member("scenes\\..\\outside.txt"),
        member("C:outside.txt"),
        member("scenes/link.xml", b"", tarfile.SYMTYPE),
        member("scenes/hard.xml", b"", tarfile.LNKTYPE),
        member("scenes/device", b"", tarfile.CHRTYPE),
        member("scenes/pipe", b"", tarfile.FIFOTYPE),
    ],
    ids=lambda info: f"{info.name}-{info.type.decode()}",
)
def test_a_pack_that_reaches_outside_is_refused_whole(
    tmp_path: Path, evil: tarfile.TarInfo
) -> None:
    packs = write_pack(tmp_path / "packs", member(FILES[0]), evil)
    with pytest.raises(AssetsError, match="get it anew"):
        unpack(packs, tmp_path / "env" / "assets")
    assert {p.name for p in tmp_path.rglob("*")} == {"packs", PACKS[0], "env"}


def test_a_damaged_pack_leaves_the_old_assets_alone(tmp_path: Path) -> None:
    packs = write_pack(tmp_path / "packs", *map(member, FILES))
    whole = (packs / PACKS[0]).read_bytes()
    target = fill(tmp_path / "assets")
    for damaged in (whole[: len(whole) // 2], b"not a pack", b""):
        (packs / PACKS[0]).write_bytes(damaged)
        with pytest.raises(AssetsError, match="cannot unpack"):
            unpack(packs, target)
        assert (target / FILES[0]).exists()


def test_a_bomb_is_not_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(assets, "_MAX_BYTES", 3)
    packs = write_pack(tmp_path / "packs", *map(member, FILES))
    with pytest.raises(AssetsError, match="too large"):
        unpack(packs, tmp_path / "assets")


def test_a_folder_without_packs_is_named(tmp_path: Path) -> None:
    with pytest.raises(AssetsError, match="COMVLA_LIBERO_ASSETS"):
        unpack(tmp_path, tmp_path / "assets")


def test_no_assets_at_all_say_how_to_get_some(tmp_path: Path) -> None:
    with pytest.raises(AssetsError, match=r"comvla-sim libero setup\s+--download"):
        find_assets(tmp_path / "package", tmp_path / "assets")


def test_authentic_assets_go_before_stand_ins(tmp_path: Path, home: Path) -> None:
    package, stand_in = tmp_path / "package", fill(tmp_path / "unpacked")
    (stand_in / "STAND-IN").touch()
    assert find_assets(package, stand_in).label == STAND_IN
    cache = fill(home / ".cache" / "libero" / "assets")
    assert find_assets(package, stand_in) == Assets(cache, AUTHENTIC)
    assert find_assets(package, stand_in).folder != stand_in
    own = fill(package / "assets")
    assert find_assets(package, stand_in).folder == own


def test_stand_ins_unpacked_by_hand_are_recognised_by_their_bytes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = fill(tmp_path / "assets")
    assert label_of(folder) == AUTHENTIC
    name = "stable_scanned_objects/plate/texture.png"
    (folder / name).write_bytes(b"another plate")
    assert label_of(folder) == AUTHENTIC
    digest = "5e82ff5d7d4a3f8f8be25ac5a1ae1d3a62e2f1ff2bc6c4e0b3bd4ad9d8a2c111"
    monkeypatch.setitem(assets._STAND_IN_SHA256, name, digest)
    assert label_of(folder) == AUTHENTIC
    monkeypatch.setitem(assets._STAND_IN_SHA256, name, _sha256(b"another plate"))
    assert label_of(folder) == STAND_IN


def _sha256(content: bytes) -> str:
    import hashlib

    return hashlib.sha256(content).hexdigest()
