"""What the Grafana dashboards show: a panel is an entry of :data:`DASHBOARDS`.

``{S}`` in a query stands for the selected job, ``{R}`` for a window that Grafana fits to the scrape
interval.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Panel:
    """One panel.

    Attributes:
        title: what it shows, in a few words.
        unit: Grafana's name of the unit.
        queries: (PromQL, legend) pairs; ``{S}`` stands for the job, ``{R}`` for the window.
        text: what to read from it, shown behind the panel's (i).
        stat: one large number instead of a graph.
        maximum: upper end of the axis, where there is a natural one.
    """

    title: str
    unit: str
    queries: Sequence[tuple[str, str]]
    text: str = ""
    stat: bool = False
    maximum: float | None = None


def rate(metric: str, selector: str = "") -> str:
    """Sum over servers of a counter's rate."""
    return f"sum(rate({metric}{{{{S}}{selector}}}[{{R}}]))"


def quantile(q: float, histogram: str, selector: str = "") -> str:
    """A quantile over all servers."""
    return (
        f"histogram_quantile({q}, sum by (le) (rate({histogram}_bucket{{{{S}}{selector}}}[{{R}}])))"
    )


def by(label: str, metric: str) -> str:
    """The same, one series for each value of a label."""
    return f"sum by ({label}) (rate({metric}{{{{S}}}}[{{R}}]))"


def ratio(part: str, whole: str) -> str:
    """A share that is 0, not undefined, where nothing happens."""
    return f"{part} / clamp_min({whole}, 1e-9)"


ANSWERED = rate("comvla_step_duration_seconds_count", ',outcome=~"ok|repeat"')
CALLS = rate("comvla_step_duration_seconds_count")
BRIDGED = rate("comvla_unanswered_steps_total")
FRAMED = rate("comvla_tx_framed_bytes_total")

DASHBOARDS: dict[str, tuple[str, list[Panel]]] = {
    "fleet": (
        "ComVLA fleet",
        [
            Panel(
                "Robots", "none", [("sum(comvla_sessions{{S}})", "")], "Sessions on record.", True
            ),
            Panel("Servers ready", "none", [("sum(comvla_server_ready{{S}})", "")], stat=True),
            Panel("Answered", "reqps", [(ANSWERED, "")], stat=True),
            Panel(
                "Answered in time",
                "percentunit",
                [
                    (
                        ratio(ANSWERED, CALLS),
                        "",
                    )
                ],
                "Share of calls that ended with actions.",
                stat=True,
                maximum=1,
            ),
            Panel(
                "Calls by outcome",
                "reqps",
                [
                    (
                        by("outcome", "comvla_step_duration_seconds_count"),
                        "{{outcome}}",
                    ),
                ],
                "ok and repeat are answers; anything else is a refusal, by reason.",
            ),
            Panel(
                "Steps that robots had to bridge",
                "percentunit",
                [
                    (
                        ratio(BRIDGED, f"({BRIDGED} + {ANSWERED})"),
                        "fallback share",
                    ),
                ],
                "Gaps between the answered steps of each robot.",
                maximum=1,
            ),
            Panel(
                "Time to an answer",
                "s",
                [
                    (quantile(0.5, "comvla_step_duration_seconds", ',outcome="ok"'), "p50"),
                    (quantile(0.95, "comvla_step_duration_seconds", ',outcome="ok"'), "p95"),
                    (quantile(0.99, "comvla_step_duration_seconds", ',outcome="ok"'), "p99"),
                ],
                "On the server, from a parsed request to its response. The link is not in it.",
            ),
            Panel("Robots per server", "none", [("comvla_sessions{{S}}", "{{instance}}")]),
        ],
    ),
    "server": (
        "ComVLA server",
        [
            Panel(
                "Inference busy",
                "percentunit",
                [("avg(comvla_inference_utilization_ratio{{S}})", "")],
                stat=True,
                maximum=1,
            ),
            Panel("Waiting", "none", [("sum(comvla_queue_depth{{S}})", "")], stat=True),
            Panel(
                "Mean batch",
                "none",
                [
                    (
                        ratio(rate("comvla_batch_size_sum"), rate("comvla_batch_size_count")),
                        "",
                    )
                ],
                stat=True,
            ),
            Panel(
                "Compute",
                "flops",
                [(rate("comvla_inference_flops_total"), "")],
                "Operations spent on answers, a multiply-add counted twice.",
                True,
            ),
            Panel(
                "Phases, p95",
                "s",
                [
                    (
                        "histogram_quantile(0.95, "
                        + by("le, phase", "comvla_step_phase_seconds_bucket")
                        + ")",
                        "{{phase}}",
                    ),
                ],
                "A long queue phase: more replicas, or fewer tokens. A long predict phase: a larger accelerator.",
            ),
            Panel(
                "Refused calls",
                "reqps",
                [
                    (
                        by("reason", "comvla_requests_dropped_total"),
                        "{{reason}}",
                    ),
                ],
            ),
            Panel(
                "Turned away at the door",
                "reqps",
                [(by("reason", "comvla_calls_refused_total"), "{{reason}}")],
                "Calls refused before they were read: no or a wrong token, above a rate.",
            ),
            Panel(
                "Batch size",
                "none",
                [
                    (quantile(0.5, "comvla_batch_size"), "p50"),
                    (quantile(0.95, "comvla_batch_size"), "p95"),
                ],
            ),
            Panel(
                "Queue and utilization",
                "none",
                [
                    ("comvla_queue_depth{{S}}", "waiting {{instance}}"),
                    ("comvla_inference_utilization_ratio{{S}}", "busy {{instance}}"),
                ],
            ),
            Panel(
                "Asked for",
                "percentunit",
                [("comvla_offered_load_ratio{{S}}", "{{instance}}")],
                "Work that robots ask for, turned away or not, as a share of what full batches can do. "
                "Steadily above 100 %: add a replica.",
            ),
            Panel(
                "Advised tokens",
                "none",
                [("comvla_suggested_tokens{{S}}", "{{instance}}")],
                "What a crowded server asks of each robot; 0: as many as the link carries.",
            ),
            Panel("Memory", "bytes", [("process_resident_memory_bytes{{S}}", "{{instance}}")]),
            Panel(
                "Open files",
                "none",
                [("process_open_fds{{S}}", "{{instance}}")],
                "A steady rise is a leak.",
            ),
            Panel(
                "Processor",
                "percentunit",
                [("rate(process_cpu_seconds_total{{S}}[{R}])", "{{instance}}")],
                "Cores in use.",
            ),
            Panel(
                "Model errors",
                "reqps",
                [(rate("comvla_model_errors_total"), "errors")],
                "Forward passes that failed or gave unusable actions: must be 0.",
            ),
        ],
    ),
    "link": (
        "ComVLA link",
        [
            Panel(
                "Uplink",
                "bps",
                [(FRAMED + " * 8", "")],
                "All robots together, with protobuf, gRPC and HTTP/2 framing.",
                True,
            ),
            Panel(
                "Bytes per request",
                "bytes",
                [
                    (
                        ratio(FRAMED, CALLS),
                        "",
                    )
                ],
                stat=True,
            ),
            Panel(
                "Tokens per request, median",
                "none",
                [(quantile(0.5, "comvla_request_tokens"), "")],
                stat=True,
            ),
            Panel(
                "Reported SNR, median",
                "dB",
                [(quantile(0.5, "comvla_reported_snr_db"), "")],
                stat=True,
            ),
            Panel(
                "Tokens per request (K)",
                "none",
                [
                    (quantile(0.1, "comvla_request_tokens"), "p10"),
                    (quantile(0.5, "comvla_request_tokens"), "p50"),
                    (quantile(0.9, "comvla_request_tokens"), "p90"),
                ],
                "Below the policy's knee (about 16) robots act on too little.",
            ),
            Panel(
                "Reported SNR",
                "dB",
                [
                    (quantile(0.1, "comvla_reported_snr_db"), "p10"),
                    (quantile(0.5, "comvla_reported_snr_db"), "p50"),
                    (quantile(0.9, "comvla_reported_snr_db"), "p90"),
                ],
                "What robots measured when they sized their payloads.",
            ),
            Panel(
                "Uplink by accounting",
                "Bps",
                [
                    (rate("comvla_tx_payload_bytes_total"), "token values, K·D·B/8"),
                    (rate("comvla_tx_encoded_bytes_total"), "with scales and positions"),
                    (rate("comvla_tx_framed_bytes_total"), "framed"),
                ],
                "The paper counts the first, the radio carries the last.",
            ),
            Panel(
                "Overhead of framing",
                "percentunit",
                [
                    (
                        ratio(FRAMED, rate("comvla_tx_payload_bytes_total")) + " - 1",
                        "over the token values",
                    ),
                ],
            ),
        ],
    ),
}
