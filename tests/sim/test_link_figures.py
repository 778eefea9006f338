"""``comvla-sim figure``: measures what is missing, draws it, and says what has to be said with it."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import pytest
from eval_stubs import made_up_link_use

from comvla_sim import cli
from comvla_sim.experiments import runner
from comvla_sim.experiments.link_case import LinkCase
from comvla_sim.experiments.plan import EpisodeSpec
from comvla_sim.figures import measuring, running
from comvla_sim.figures.points import pairs, points
from comvla_sim.figures.series import SERIES, USEFUL_TOKENS
from comvla_sim.figures.sweeps import SWEEPS
from comvla_sim.figures.tables import tables
from comvla_sim.worlds.tabletop import Tabletop

pytestmark = pytest.mark.simulator

PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture(autouse=True)
def short_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Tabletop, "max_episode_steps", 8)


def figure(name: str, out: Path, *options: str) -> int:
    fixed = ["--model", "random", "--instructions", "drawer-open"]
    if name != "episode":
        fixed += ["--workers", "1"]
    return cli.main(["figure", name, "--out", str(out), *fixed, *options])


def printed(capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def read(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def check_files(found: dict[str, Any]) -> None:
    """Every picture is there twice, and is what its name says."""
    assert {Path(file).suffix for file in found["files"]} == {".svg", ".png"}
    for file in found["files"]:
        content = Path(file).read_bytes()
        if file.endswith("svg"):
            ElementTree.fromstring(content)
        else:
            assert content.startswith(PNG)
        assert len(content) < 400_000


def test_success_against_fading_with_and_without_enforcement(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ("--mean-snr-db", "0,20", "--episodes", "2")
    assert figure("fading", tmp_path, *options, "--json") == 0
    found = printed(capsys)
    check_files(found)
    names = SWEEPS["fading"].series
    seen = {(p["series"], p["axes"]["channel"], p["axes"]["mean_snr_db"]) for p in found["points"]}
    assert seen == {(n, c, s) for n in names for c in ("rayleigh", "rician") for s in (0.0, 20.0)}
    for point in found["points"]:
        assert point["episodes"] == 2
        assert 0 <= point["low"] <= point["success_rate"] <= point["high"] <= 1
        link = point["link"]
        if point["series"] == "full":
            assert link is None
        else:
            assert (link["csi_delay"], link["bandwidth_hz"]) == (1, 0.18e6)
            assert link["enforce"] == SERIES[point["series"]].enforce
    for said in ("0.18 MHz", "2 episodes per point", "no fair comparison", "4 tokens", "Wilson"):
        assert said in found["caption"]
    # Full transmission over an ideal link is one measurement, not one for each link.
    assert len(read(tmp_path / "fading.jsonl")) == 2 * (1 + 4 * 4)
    assert json.loads((tmp_path / "fading.json").read_text()) == found


def test_age_of_reports_counts_violations(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ("--csi-delay", "0,2", "--episodes", "2", "--series", "unenforced,drop,margin")
    assert figure("csi-delay", tmp_path, *options, "--json") == 0
    found = printed(capsys)
    check_files(found)
    uses = {(p["series"], p["axes"]["csi_delay"]): p["link_use"] for p in found["points"]}
    assert uses["drop", 0]["overruns"]["above_capacity"] == 0
    # By the paper's own count nothing is above at d = 0; by all bytes on the wire everything is.
    assert uses["unenforced", 0]["payload_overruns"]["above_capacity"] == 0
    assert uses["unenforced", 0]["overruns"]["share"] == 1.0
    assert {test["second"] for test in found["comparisons"]} == {"drop", "margin"}
    assert [t["pairs"] for t in found["comparisons"]] == [2, 2, 4, 2, 2, 4]
    assert "no fair comparison" not in found["caption"]


def test_a_second_run_measures_nothing_and_draws_the_same(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    options = ("--csi-delay", "1", "--episodes", "1", "--series", "drop,prefix")
    assert figure("csi-delay", tmp_path, *options) == 0
    shown = capsys.readouterr().out
    assert shown.startswith((tmp_path / "csi-delay.md").read_text())
    assert "| enforced: what fits is used |" in shown
    assert "Wilson" in shown
    pictures = {path: path.read_bytes() for path in tmp_path.iterdir()}
    monkeypatch.setattr(runner.Worker, "run", None)  # whoever runs an episode fails
    assert figure("csi-delay", tmp_path, *options) == 0
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == pictures


def test_figures_in_one_folder_share_their_episodes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shared = ("--episodes", "1", "--channel", "rayleigh", "--mean-snr-db", "10", "--csi-delay", "1")
    assert figure("csi-delay", tmp_path, *shared, "--series", "drop,prefix") == 0
    ran: list[EpisodeSpec] = []
    run = runner.Worker.run

    def counted(self: runner.Worker, spec: EpisodeSpec, *rest: Any) -> Any:
        ran.append(spec)
        return run(self, spec, *rest)

    monkeypatch.setattr(runner.Worker, "run", counted)
    assert figure("fading", tmp_path, *shared, "--series", "full,drop") == 0
    assert [spec.method for spec in ran] == ["full"]
    drop = [row for row in read(tmp_path / "fading.jsonl") if row["method"] == "hard_voting"]
    assert drop == [
        row for row in read(tmp_path / "csi-delay.jsonl") if row["link"]["enforce"] == "drop"
    ]
    # Another seed has other tables, and nothing is shared.
    assert figure("fading", tmp_path / "b", *shared, "--series", "drop", "--seed", "1") == 0
    assert len(ran) == 2


def test_ctrl_c_leaves_what_was_measured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    options = ("--csi-delay", "1", "--episodes", "2", "--series", "drop")
    run = runner.Worker.run

    def interrupted(self: runner.Worker, spec: EpisodeSpec, *rest: Any) -> Any:
        if spec.episode == 1:
            raise KeyboardInterrupt
        return run(self, spec, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(runner.Worker, "run", interrupted)
        assert figure("csi-delay", tmp_path, *options) == 130
    assert "goes on from" in capsys.readouterr().err
    assert len(read(tmp_path / "csi-delay.jsonl")) == 1
    assert figure("csi-delay", tmp_path, *options) == 0
    assert len(read(tmp_path / "csi-delay.jsonl")) == 2


def test_one_episode_period_by_period(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ("--series", "drop,progressive+floor", "--mean-snr-db", "8", "--json")
    assert figure("episode", tmp_path, *options) == 0
    found = printed(capsys)
    check_files(found)
    assert set(found["lines"]) == {"drop", "progressive+floor"}
    for line in found["lines"].values():
        row, periods = line["row"], line["periods"]
        assert len(periods) == row["steps"] == 8
        assert len(line["queries"]) == row["queries"]
        for query in line["queries"]:
            if query["link"] is not None:
                now = periods[query["period"]]
                assert query["link"]["snr_db"] == now["snr_db"]
                assert query["link"]["capacity_bits"] == pytest.approx(
                    now["capacity_bits"], abs=0.1
                )
        assert str(row["channel_seed"]) in line["caption"]
        assert "0.18 MHz" in line["caption"]


def test_quick_is_small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []

    def no_measuring(name: str, study: measuring.Study, wanted: list[EpisodeSpec]) -> None:
        asked.append(len(wanted))
        raise KeyboardInterrupt

    monkeypatch.setattr(running, "measure", no_measuring)
    for name in SWEEPS:
        for options in (("--quick",), ()):
            assert figure(name, tmp_path, *options) == 130
    # One instruction: lines × links × tables; "full" has no link.
    assert asked == [2 * (1 + 4 * 2 * 3), 20 * (1 + 4 * 2 * 5), 2 * 5 * 2, 20 * 5 * 5]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("fading", "--series", "magic"), "--series 'magic'"),
        (("fading", "--series", ","), "--series is empty"),
        (("fading", "--mean-snr-db", ","), "is empty"),
        (("csi-delay", "--csi-delay", "-1"), "--csi-delay"),
        (("csi-delay", "--channel", "fog"), "--channel 'fog'"),
        (("csi-delay", "--bandwidth-hz", "0"), "bandwidth_hz"),
        (("csi-delay", "--episodes", "0"), "--episodes"),
        (("csi-delay", "--workers", "-1"), "--workers"),
        (("episode", "--series", "full"), "no link"),
        (("episode", "--csi-delay", "0,1"), "one link"),
    ],
)
def test_nonsense_is_refused_before_anything_runs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: tuple[str, ...], message: str
) -> None:
    assert figure(options[0], tmp_path / "out", *options[1:]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert "Traceback" not in error
    assert not (tmp_path / "out").exists()


def made_up(series: str, link: LinkCase, task: str, episode: int, success: bool) -> Any:
    spec = SERIES[series].spec(link, task, episode, 512)
    row = {
        "success": success,
        "steps": 50 if success else 160,
        "queries": 10,
        "framed_bytes": 5000,
        "link_use": None,
    }
    return spec, row


def test_points_and_pairs_are_what_one_counts_by_hand() -> None:
    links = [LinkCase(mean_snr_db=snr, bandwidth_hz=0.18e6) for snr in (0.0, 10.0)]
    rows = dict(
        made_up(series, link, task, episode, wins[series] > episode + 2 * (link == links[0]))
        for wins in [{"full": 9, "drop": 3, "prefix": 4}]
        for series in wins
        for link in links
        for task in ("a", "b")
        for episode in range(5)
    )
    series = {name: SERIES[name] for name in ("full", "drop", "prefix")}
    found = points(rows, series, links)
    counts = [(p.series, p.axes["mean_snr_db"], p.successes, p.episodes) for p in found]
    assert counts == [
        ("full", 0.0, 10, 10),
        ("full", 10.0, 10, 10),
        ("drop", 0.0, 2, 10),
        ("drop", 10.0, 6, 10),
        ("prefix", 0.0, 4, 10),
        ("prefix", 10.0, 8, 10),
    ]
    assert found[3].periods == 50
    assert found[3].bytes_per_query == 500
    test = pairs(rows, series["drop"], series["prefix"], links)
    assert (test["pairs"], test["only_first"], test["only_second"]) == (20, 0, 4)
    # Two layouts differ, on both tasks each: repetitions of one layout are no further evidence.
    assert (test["layouts"], test["p_value"]) == (5, 2 / 2**2)
    alone = pairs(rows, series["drop"], series["prefix"], links[:1])
    assert (alone["pairs"], alone["only_second"], alone["p_value"]) == (10, 2, 2 / 2**2)


def test_tables_have_lines_down_and_what_was_varied_across() -> None:
    links = [LinkCase("rayleigh", snr, 1, bandwidth_hz=0.18e6) for snr in (0.0, 10.0)]
    series = {name: SERIES[name] for name in ("full", "drop", "progressive+floor")}
    rows = dict(
        made_up(name, link, "a", episode, episode < 3)
        for name in series
        for link in links
        for episode in range(4)
    )
    for spec, row in rows.items():
        if spec.link is not None:
            row["link_use"] = made_up_link_use((0.5, 2.0))
    success, above, answered, time = tables("fading", points(rows, series, links))
    assert success.title == "Success, rayleigh, reports 1 period old"
    assert success.header == ("line", "0 dB", "10 dB")
    assert [row[0] for row in success.rows] == [line.label for line in series.values()]
    assert success.rows[0][1:] == ("75.0 (30.1–95.4)",) * 2
    assert above.rows == (("enforced: too large is lost", "50.0, ×2.0", "50.0, ×2.0"),)
    assert answered.rows[1] == ("enforced: progressive with a floor", "25.0", "25.0")
    assert time.rows[0][1:] == ("50", "50")


def test_lines_use_one_link_each_in_their_way() -> None:
    link = LinkCase("rayleigh", 5.0, 3, bandwidth_hz=0.2e6)
    specs = {name: line.spec(link, "t", 0, 512) for name, line in SERIES.items()}
    assert len(set(specs.values())) == len(SERIES)
    for name, spec in specs.items():
        if spec.link is None:
            assert name == "full"
            continue
        assert (spec.link.channel, spec.link.csi_delay, spec.link.bandwidth_hz) == (
            "rayleigh",
            3,
            0.2e6,
        )
        assert (spec.link.useful_tokens == USEFUL_TOKENS) == ("floor" in spec.link.sending)
        assert spec.k == (512 if spec.method == "full" else None)
