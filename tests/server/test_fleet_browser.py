"""The page of the fleet in a real browser: what a person sees, and can do with a keyboard."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from chromium import Visit, chromium, needs_chromium
from server_stubs import Robot, StubCloud, message, quiet_port

from comvla_server.background import BackgroundServer
from comvla_server.engine import Engine
from comvla_server.identity import Identity
from comvla_server.settings import ServerSettings
from comvla_server.tokens import TokenLine, new_token

pytestmark = [needs_chromium, pytest.mark.slow]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as running:
        yield running


@pytest.fixture
def visit(browser: Any) -> Iterator[Callable[..., Visit]]:
    """Opens pages; none of them may complain or ask anybody but the server."""
    visits: list[tuple[Visit, str, tuple[str, ...]]] = []

    def open_page(url: str, allow: tuple[str, ...] = (), **context: Any) -> Visit:
        made = Visit(browser, **context)
        visits.append((made, url, allow))
        made.page.goto(url)
        return made

    yield open_page
    for made, url, allow in visits:
        made.close()
        assert all(address.startswith(url) for address in made.asked)
        unexpected = [c for c in made.complaints if not any(part in c for part in allow)]
        assert unexpected == []


@pytest.fixture
def page(visit: Callable[..., Visit], server: BackgroundServer, robot: Robot) -> Visit:
    """The page, with three robots on it."""
    for number, k in ((10, 5), (2, 3), (1, 4)):
        for step in range(2):
            robot.infer(message(f"arm-{number}.0a1b2c3d.0", step, k=k))
    opened = visit(server.admin_url)
    opened.wait("document.querySelectorAll('#rows tr').length === 3")
    return opened


def order(page: Visit) -> list[str]:
    return list(
        page.page.evaluate(
            "[...document.querySelectorAll('#rows .pick')].map((e) => e.firstChild.textContent)"
        )
    )


def test_it_shows_the_fleet_and_one_robots_tokens(page: Visit, robot: Robot) -> None:
    assert page.text("#model") == "stub"
    assert page.text("#state-word") == "serving"
    assert order(page) == ["arm-1", "arm-2", "arm-10"]
    assert page.text("#chosen-title") == "arm-1"
    page.wait("document.querySelector('canvas')?.dataset.kept === '4'")
    label = page.page.locator("canvas").get_attribute("aria-label")
    assert label == "View 1: 4 of 16 tokens kept, on a grid of 4 by 4"
    assert "4 of 16 tokens sent (25.0 %), step 1" in page.text("#views-note")
    assert page.text("#chosen-says") == "open it"
    # Four cells of the grid are painted, and no more: the middle of each cell tells.
    painted = page.page.evaluate(
        """() => {
          const canvas = document.querySelector("canvas"), pen = canvas.getContext("2d");
          const colours = new Map();
          for (let r = 0; r < 4; r++) for (let c = 0; c < 4; c++) {
            const at = [(c + 0.5) * canvas.width / 4, (r + 0.5) * canvas.height / 4].map(Math.floor);
            const colour = pen.getImageData(...at, 1, 1).data.join();
            colours.set(colour, (colours.get(colour) ?? 0) + 1);
          }
          return [...colours.values()].sort((a, b) => b - a);
        }"""
    )
    assert painted == [12, 1, 1, 1, 1]
    robot.infer(message("arm-1.0a1b2c3d.0", 2, k=7))
    page.wait("document.querySelector('canvas')?.dataset.kept === '7'")


@pytest.mark.alone
def test_a_step_is_on_the_page_within_a_second(page: Visit, robot: Robot) -> None:
    """From the server's answer to the document, on one machine's clock."""
    page.page.evaluate(
        """() => {
          window.shownAt = {};
          const row = document.querySelector('tr[data-robot="arm-1.0a1b2c3d"]');
          new MutationObserver(() => { window.shownAt[row.dataset.step] ??= Date.now() / 1000; })
            .observe(row, { attributes: true });
        }"""
    )
    delays = []
    for step in range(2, 14):
        robot.infer(message("arm-1.0a1b2c3d.0", step))
        answered_s = time.time()
        page.wait(f"{step} in window.shownAt")
        delays.append(page.page.evaluate(f"window.shownAt['{step}']") - answered_s)
        time.sleep(0.05 * (step % 4))  # at different times after the event before
    assert statistics.median(delays) < 1.0
    assert sum(delay < 1.0 for delay in delays) >= len(delays) - 1


def test_what_a_robot_says_is_text(page: Visit, robot: Robot) -> None:
    hostile = "<img src=x onerror='document.title=1'><script>document.title=2</script>"
    robot.infer(message("arm-1.0a1b2c3d.0", 2, instruction=hostile))
    page.wait("document.getElementById('chosen-says').textContent.includes('script')")
    assert page.text("#chosen-says") == hostile
    assert page.page.locator("main img, main script").count() == 0
    assert "ComVLA fleet" in page.page.title()


def test_a_keyboard_is_enough(page: Visit) -> None:
    press = page.page.keyboard.press
    press("Tab")
    assert page.page.evaluate("document.activeElement.className") == "skip"
    press("Enter")
    press("Tab")  # into the table: the heading of the first column
    assert page.page.evaluate("document.activeElement.textContent.trim()").startswith("Robot")
    press("Enter")  # sorted the other way round
    assert order(page) == ["arm-10", "arm-2", "arm-1"]
    assert page.page.locator("th[aria-sort]").get_attribute("aria-sort") == "descending"
    page.page.locator("#rows .pick").first.focus()
    press("ArrowDown")
    press("Enter")
    assert page.text("#chosen-title") == "arm-2"
    assert page.page.locator(".pick[aria-pressed=true]").count() == 1
    press("End")
    press("Space")
    page.wait("document.getElementById('chosen-title').textContent === 'arm-1'")
    page.page.locator(".chart svg").first.focus()
    press("ArrowLeft")
    press("ArrowLeft")
    page.wait("document.querySelector('.chart .cursor') !== null")
    assert "ago" in (page.page.locator(".chart svg").first.get_attribute("aria-label") or "")
    press("Escape")
    page.wait("document.querySelector('.chart .cursor') === null")


def test_everything_has_a_name_and_a_role(page: Visit) -> None:
    unnamed = page.page.evaluate(
        """[...document.querySelectorAll("button, input:not([hidden]), a, svg[role], canvas, section, aside")]
          .filter((e) => !(e.textContent.trim() || e.getAttribute("aria-label")
            || e.getAttribute("aria-labelledby") || e.labels?.length)).map((e) => e.outerHTML.slice(0, 80))"""
    )
    assert unnamed == []
    assert page.page.locator("[role=status]").count() == 1
    assert page.page.locator("table caption").count() == 1
    assert page.page.locator("thead th[scope=col]").count() == 11
    assert page.page.locator("tbody th[scope=row]").count() == 3


@pytest.mark.parametrize("width", [400, 800, 1000, 1120, 1280, 1440, 1920])
def test_the_table_stays_within_its_card(page: Visit, width: int) -> None:
    page.page.set_viewport_size({"width": width, "height": 900})
    beyond = page.page.evaluate(
        """document.getElementById("robots-table").getBoundingClientRect().right
          - document.getElementById("robots").getBoundingClientRect().right"""
    )
    assert beyond < 0
    assert page.sideways() == 0


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_it_fits_a_phone(
    visit: Callable[..., Visit], server: BackgroundServer, robot: Robot, scheme: str
) -> None:
    for number in range(4):
        robot.infer(message(f"{'long-name-' * 9}{number}.0"))
    phone = visit(
        server.admin_url,
        viewport={"width": 360, "height": 740},
        color_scheme=scheme,
        reduced_motion="reduce",
        is_mobile=True,
        has_touch=True,
    )
    phone.wait("document.querySelectorAll('#rows tr').length === 4")
    phone.wait("document.querySelector('canvas')?.dataset.kept === '3'")
    assert phone.sideways() == 0
    background = phone.page.evaluate("getComputedStyle(document.body).backgroundColor")
    assert (sum(map(int, background[4:-1].split(","))) < 200) == (scheme == "dark")
    assert phone.page.evaluate("document.getAnimations().length") == 0
    small = phone.page.evaluate(
        """[...document.querySelectorAll("button")].filter((e) => e.checkVisibility()
          && Math.min(e.clientHeight, e.clientWidth) < 24).map((e) => e.outerHTML)"""
    )
    assert small == []  # each can be hit with a finger


def test_an_open_page_heals_when_the_server_is_back(
    visit: Callable[..., Visit], cloud: StubCloud
) -> None:
    settings = ServerSettings(admin_port=quiet_port())
    with BackgroundServer(Engine(cloud), settings) as first, Robot(first.target) as robot:
        robot.infer(message("before.0"))
        page = visit(first.admin_url, allow=("ERR_CONNECTION", "ERR_INCOMPLETE", "ERR_EMPTY"))
        page.wait("document.querySelectorAll('#rows tr').length === 1")
    page.wait("document.getElementById('state-word').textContent === 'connection lost'")
    assert "Connection lost, retrying" in page.text("#banner")
    assert page.page.locator("#live").get_attribute("class") == "stale"
    assert page.text("#rows .pick").startswith("before")  # what was known stays, marked as old
    with BackgroundServer(Engine(StubCloud()), settings) as second:
        page.wait("document.getElementById('state-word').textContent === 'serving'")
        page.wait("document.querySelectorAll('#rows tr').length === 0")
        assert not page.page.locator("#banner").is_visible()
        with Robot(second.target) as robot:
            robot.infer(message("after.0"))
            page.wait("document.querySelectorAll('#rows tr').length === 1")
        assert page.text("#rows .pick").startswith("after")


def test_a_token_opens_it_and_stays_in_the_tab(
    visit: Callable[..., Visit], cloud: StubCloud, tmp_path: Path
) -> None:
    token, file = new_token(), tmp_path / "admin"
    file.touch(mode=0o600)
    file.write_text(f"{TokenLine.of(Identity('operator'), token)}\n")
    settings = ServerSettings(admin_tokens_file=file, reload_interval_s=0.02)
    with BackgroundServer(Engine(cloud), settings) as server:
        page = visit(server.admin_url, allow=("401",))
        page.wait("document.activeElement.id === 'token'")
        page.page.keyboard.type("wrong")
        page.page.keyboard.press("Enter")
        page.wait("document.getElementById('sign-in-error').textContent.includes('none of')")
        page.page.keyboard.type(token)
        page.page.keyboard.press("Enter")
        page.wait("document.getElementById('state-word').textContent === 'serving'")
        assert not page.page.locator("#sign-in").is_visible()
        page.page.reload()
        page.wait("document.getElementById('state-word').textContent === 'serving'")
        assert token not in page.page.url
        assert not any(token in address for address in page.asked)
        assert page.page.context.cookies() == []
        assert page.page.evaluate("JSON.stringify(localStorage)") == "{}"
        page.page.locator("#sign-out").click()
        page.wait("document.activeElement.id === 'token'")
        page.page.keyboard.type(token)
        page.page.keyboard.press("Enter")
        page.wait("document.getElementById('state-word').textContent === 'serving'")
        file.write_text(f"{TokenLine.of(Identity('new'), new_token())}\n")  # taken away
        page.wait("document.activeElement.id === 'token'")
