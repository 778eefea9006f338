"""Files that are watched, and the open files that connections need."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path

import pytest

from comvla.errors import ComVLAError
from comvla_server.descriptors import allow_descriptors
from comvla_server.secret_files import Watcher
from comvla_server.settings import ServerSettings

resource = pytest.importorskip("resource", reason="needs POSIX limits")


class Item:
    """Counts how often it was read, and fails when told to."""

    def __init__(self, path: Path) -> None:
        self.paths = (path,)
        self.reloads = 0
        self.error: Exception | None = None

    def reload(self) -> None:
        self.reloads += 1
        if self.error is not None:
            raise self.error


@pytest.fixture
def item(tmp_path: Path) -> Item:
    path = tmp_path / "secret"
    path.write_text("a")
    return Item(path)


def test_only_what_changed_is_read_again(item: Item) -> None:
    watcher = Watcher({"tokens": item}, 1.0, lambda _: None)
    for _ in range(3):
        watcher.look()
    assert item.reloads == 1, "the first look closes the gap to the reading before it"
    item.paths[0].write_text("bb")
    watcher.look()
    watcher.look()
    assert item.reloads == 2
    item.paths[0].unlink()
    watcher.look()
    assert item.reloads == 3, "a file that went away is a change"


def test_a_link_that_is_turned_is_a_change(item: Item, tmp_path: Path) -> None:
    """Kubernetes renews mounted secrets so."""
    (tmp_path / "one").write_text("x")
    (tmp_path / "two").write_text("x")
    link = tmp_path / "link"
    link.symlink_to("one")
    item.paths = (link,)
    watcher = Watcher({"tokens": item}, 1.0, lambda _: None)
    watcher.look()
    fresh = tmp_path / "fresh"
    fresh.symlink_to("two")
    fresh.replace(link)
    watcher.look()
    assert item.reloads == 2


@pytest.mark.parametrize("error", [ComVLAError("bad line"), RuntimeError("never thought of")])
def test_nothing_ends_the_watch(
    item: Item, caplog: pytest.LogCaptureFixture, error: Exception
) -> None:
    failed: list[str] = []
    watcher = Watcher({"tokens": item}, 1.0, failed.append)
    watcher.look()
    item.error = error
    item.paths[0].write_text("bb")
    watcher.look()
    watcher.look()
    assert failed == ["tokens"], "told once"
    assert f"the old one stays: {error}" in caplog.text
    item.error = None
    watcher.look()
    watcher.look()
    assert item.reloads == 4, "tried again until it is good, though the file stayed as it is"


@pytest.fixture
def few_files() -> Iterator[None]:
    """A soft limit as many shells have it."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard < 2000:
        pytest.skip("needs a hard limit of 2000 open files")
    resource.setrlimit(resource.RLIMIT_NOFILE, (1024, hard))
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@pytest.mark.usefixtures("few_files")
def test_the_limit_of_open_files_follows_the_connections(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.WARNING)
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    allow_descriptors(ServerSettings(max_connections=1200))
    assert resource.getrlimit(resource.RLIMIT_NOFILE) == (1200 + 256 + 128, hard)
    allow_descriptors(ServerSettings(max_connections=10))
    assert resource.getrlimit(resource.RLIMIT_NOFILE)[0] == 1584, "never lowered"
    assert not caplog.records
    if hard != resource.RLIM_INFINITY and hard < 10**6:
        allow_descriptors(ServerSettings(max_connections=10**6))
        assert "ulimit -n" in caplog.text
