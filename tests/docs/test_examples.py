"""Every Python example of the documentation runs as it is printed, against a real server."""

from __future__ import annotations

from collections.abc import Iterator

import markdown
import pytest

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


@pytest.mark.parametrize("example", EXAMPLES, ids=str)
def test_example_runs(example: markdown.Block, server: BackgroundServer) -> None:
    code = example.code.replace(PRINTED_ADDRESS, server.target)
    # The padding makes a failure point at the line of the page.
    exec(compile("\n" * (example.line - 1) + code, str(example.page), "exec"), {})
