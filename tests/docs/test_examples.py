"""Every Python example of the documentation runs as it is printed, against a real server."""

from __future__ import annotations

import functools
from collections.abc import Iterator

import markdown
import pytest

import comvla_client
from comvla_client.registry import SELECTORS
from comvla_server.background import BackgroundServer
from comvla_server.engine import Engine
from comvla_server.vision import VisionHalf
from comvla_vla import load_cloud, load_edge

PRINTED_ADDRESS = "127.0.0.1:50051"
EXAMPLES = [block for page in markdown.PAGES for block in markdown.blocks(page, "python")]


@pytest.fixture(scope="module")
def server() -> Iterator[BackgroundServer]:
    with BackgroundServer(Engine(load_cloud("mini"), VisionHalf(load_edge("mini")))) as running:
        yield running


def test_the_guides_have_examples() -> None:
    pages = {example.page.name for example in EXAMPLES}
    assert {"README.md", "edge-sdk.md", "server.md", "simulation.md", "selectors.md"} <= pages


@pytest.fixture(autouse=True)
def unregistered() -> Iterator[None]:
    """What an example registers does not stay."""
    before = dict(SELECTORS)
    yield
    SELECTORS.clear()
    SELECTORS.update(before)


def run(example: markdown.Block, server: BackgroundServer) -> None:
    code = example.code.replace(PRINTED_ADDRESS, server.target)
    # The padding makes a failure point at the line of the page.
    exec(compile("\n" * (example.line - 1) + code, str(example.page), "exec"), {})


@pytest.mark.parametrize("example", EXAMPLES, ids=str)
def test_example_runs(example: markdown.Block, server: BackgroundServer) -> None:
    run(example, server)


def test_the_first_example_prints_what_is_written_beside_it(
    server: BackgroundServer, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    # The default deadline is a robot's: a busy machine may miss it.
    patient = functools.partial(comvla_client.ComVLAClient, deadline_s=60.0)
    monkeypatch.setattr(comvla_client, "ComVLAClient", patient)
    [example] = [e for e in EXAMPLES if e.page.name == "README.md" and "robot.step" in e.code]
    assert '# "cloud" and (8, 4)' in example.code
    run(example, server)
    assert capsys.readouterr().out.startswith("cloud (8, 4)\n")
