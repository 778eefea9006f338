"""Tables of the documentation say what the code does, and links lead somewhere."""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

import markdown
import pytest

from comvla.codec import payload_bytes
from comvla_client import LinkProfile, token_budget
from comvla_client.registry import IMAGE_FORMS, SELECTORS
from comvla_client.report import StepReport
from comvla_client.snr import __all__ as SNR_NAMES
from comvla_server.metrics import Metrics
from comvla_server.setting_fields import fields_of
from comvla_server.settings import ServerSettings
from comvla_server.statuses import STATUS

README = markdown.ROOT / "README.md"
SERVER = markdown.ROOT / "docs" / "server.md"
SELECTOR_GUIDE = markdown.ROOT / "docs" / "selectors.md"
EDGE = markdown.ROOT / "docs" / "edge-sdk.md"


@pytest.mark.parametrize("page", markdown.PAGES, ids=lambda page: str(page.name))
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", markdown.prose(page)):
        if target.startswith("https://"):
            continue
        file, _, fragment = target.partition("#")
        linked = (page.parent / file).resolve() if file else page
        assert linked.is_file(), f"{page.name} links to {target}"
        if fragment:
            assert fragment in markdown.anchors(linked), f"{page.name} links to {target}"


def test_pictures_are_well_formed_and_load_nothing() -> None:
    pictures = list((markdown.ROOT / "docs").glob("*.svg"))
    assert pictures
    for picture in pictures:
        for element in ElementTree.parse(picture).iter():
            links = [value for name, value in element.attrib.items() if name.endswith("href")]
            assert all(value.startswith("#") for value in links), "only within the picture itself"


def test_the_readme_counts_tokens_as_eq_4_does() -> None:
    links = ((2176, LinkProfile()), (96, LinkProfile(bandwidth_hz=0.88e6)))
    for snr, *cells in markdown.table(README, "SNR"):
        snr_db = float(snr.removesuffix(" dB"))
        for (dim, link), k, payload in zip(links, cells[::2], cells[1::2], strict=True):
            assert int(k) == token_budget(snr_db, link, dim * 8)
            assert payload == f"{payload_bytes(int(k), dim, 'int8') / 1024:.1f} KiB"


def test_the_server_guide_names_every_metric_with_its_type() -> None:
    exported = {}
    for family in Metrics().registry.collect():
        if family.name.startswith("comvla_"):
            suffix = "_total" if family.type == "counter" else ""
            exported[f"`{family.name}{suffix}`"] = family.type
    assert {row[0]: row[1] for row in markdown.table(SERVER, "metric")} == exported


def test_the_server_guide_states_the_limits_that_are_in_force() -> None:
    fields = {field.flag: field for field in fields_of(ServerSettings).values()}
    stated = {row[0].strip("`"): float(row[1]) for row in markdown.table(SERVER, "option")}
    assert stated == {flag: fields[flag].serve_default for flag in stated}
    numbers = {flag for flag, field in fields.items() if field.kind in (int, float)}
    elsewhere = {
        "--port",
        "--admin-port",
        "--reload-interval-s",
        "--session-ttl-s",
        "--otel-sample",
    }
    assert set(stated) == numbers - elsewhere


def test_the_server_guide_explains_every_status_that_a_robot_can_see() -> None:
    codes = {status.name for status in STATUS.values()} - {"CANCELLED"}  # that robot has hung up
    assert {row[0] for row in markdown.table(SERVER, "code")} == codes


def test_the_edge_guide_names_every_selector_and_every_field_of_the_report() -> None:
    rows = markdown.table(EDGE, "`selector=`")
    assert {name for row in rows for name in re.findall(r'"(\w+)"', row[0])} == set(SELECTORS)
    named = {
        name for row in markdown.table(EDGE, "fields") for name in re.findall(r"`(\w+)`", row[0])
    }
    assert named == set(StepReport.__dataclass_fields__)


def test_the_edge_guide_names_every_snr_source() -> None:
    rows = markdown.table(EDGE, "source")
    named = {name for row in rows for name in re.findall(r"`(\w+Snr)\(", row[0])}
    assert named == {name for name in SNR_NAMES if name.endswith("Snr")}


def test_the_guide_of_selectors_says_what_their_table_says() -> None:
    rows = markdown.table(SELECTOR_GUIDE, "name | equation")
    assert {row[0].strip("`"): row[2] for row in rows} == {
        name: entry.source for name, entry in SELECTORS.items()
    }
    named = " ".join(row[0] for row in markdown.table(SELECTOR_GUIDE, "name | | |"))
    assert set(re.findall(r"`(\w+)(?:-\w)?`", named)) == set(IMAGE_FORMS)
