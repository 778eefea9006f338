"""Accounts of the link for people to read."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from comvla_sim.bench.table import render


def describe_run(account: Mapping[str, Any]) -> str:
    """What was in time, what was sent, and whether the link was as it should be."""
    settings, summary, where = account["settings"], account["summary"], account["environment"]
    channel = settings["channel"]
    heading = (
        f"{settings['scale']} scale, sending {settings['sending']}, {channel['kind']}, "
        f"{account['link']['bandwidth_hz'] / 1e6:g} MHz, T = {1e3 * settings['period_s']:g} ms, "
        f"CSI {settings['csi_delay']} periods old, {settings['minutes']:g} min, a query every "
        f"{settings['every']} periods; load {where['load_average']:.1f} to "
        f"{where['load_average_at_end']:.1f} on {where['cores']} cores"
        f"{', real-time priority' if settings['realtime'] else ''}"
    )
    shares = [
        [words, *_share(summary[name])]
        for name, words in (
            ("sent", "sent"),
            ("payload_in_time", "payload through within the period"),
            ("answer_in_time", "answer within the period"),
            ("answer_in_time_of_sent", "answer within the period, of those sent"),
            (
                "answer_in_time_undisturbed",
                "the same, where the host took no time from this machine",
            ),
            ("useful_answer_in_time", "answer within the period to 20 tokens or more"),
            ("larger_than_capacity", "larger than the period's capacity"),
        )
    ]
    spreads = [
        [words, *(_number(summary[name][p], factor) for p in ("p10", "p50", "p90", "p99", "max"))]
        for name, words, factor in (
            ("payload_complete_after_s", "payload through after, ms", 1e3),
            ("answered_after_s", "answered after, ms", 1e3),
            ("started_late_s", "step began late by, ms", 1e3),
            ("tokens", "tokens sent, K", 1.0),
            ("tokens_used", "tokens used", 1.0),
        )
    ]
    nbytes, link = summary["bytes"], summary["link"]
    late = account["change_lateness"]
    measured = account["measured_before"]
    return "\n".join(
        [
            heading,
            "",
            render(["queries", "count", "of", "share", "95 % interval"], shares),
            "",
            render(["", "p10", "p50", "p90", "p99", "max"], spreads),
            "",
            f"bytes: payload {nbytes['payload']}, framed {nbytes['framed']}, IP packets up "
            f"{nbytes['ip_up']} (with the measuring before), capacity {nbytes['capacity']:.0f}",
            f"late payloads: {summary['backlog']['late_payloads']['count']}, of them never through: "
            f"{summary['backlog']['never_complete']}",
            f"link: {link['over_capacity']['count']} of {link['periods']} periods passed a packet or "
            f"more above capacity; rate changed {1e3 * late['p99_s']:.1f} ms late at the 99th "
            f"percentile, {1e3 * late['max_s']:.1f} ms at most",
            f"kept of the period: {1e3 * measured['reserve_s']:.1f} ms, where edge, server and way "
            f"back take {1e3 * measured['overhead_median_s']:.1f} ms (95 %: "
            f"{1e3 * measured['overhead_p95_s']:.1f} ms)",
        ]
    )


def describe_flaps(account: Mapping[str, Any]) -> str:
    """How the robot came through the flaps."""
    summary, parameters = account["summary"], account["parameters"]
    median, worst = summary["median_recovery_periods"], summary["worst_recovery_periods"]
    return "\n".join(
        [
            f"{summary['flaps']} flaps of {parameters['shortest_s']:g} to "
            f"{parameters['longest_s']:g} s, one-way delay {parameters['delay_ms']:g} ms, deadline "
            f"{1e3 * parameters['deadline_s']:g} ms; load "
            f"{account['environment']['load_average']:.1f}",
            f"  steps: {summary['steps']}, answered: {summary['answered']}, exceptions: "
            f"{summary['exceptions']}, older chunk after a newer one: "
            f"{summary['older_after_newer']}",
            f"  next answer within {summary['allowed_periods']:g} periods of the link's return: "
            f"{summary['within_allowed']} of {summary['flaps']}; median {_number(median)}, worst "
            f"{_number(worst)} periods",
            f"  longest step: {1e3 * summary['longest_step_s']:.0f} ms",
        ]
    )


def _share(row: Mapping[str, Any]) -> list[str]:
    if not row["of"]:
        return ["0", "0", "-", "-"]
    return [
        str(row["count"]),
        str(row["of"]),
        f"{100 * row['share']:.2f} %",
        f"{100 * row['low']:.2f} to {100 * row['high']:.2f} %",
    ]


def _number(value: float | None, factor: float = 1.0) -> str:
    return "-" if value is None else f"{factor * value:.1f}"
