"""Writes the Grafana dashboards: ``python docker/grafana/build.py`` after a change here.

The panels are described in ``panels.py``; layout and style follow from that. The JSON files are
committed, so that Grafana needs no Python; a test compares them with this program's output.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from grafana_foundation_sdk.builders import common, dashboard, prometheus, stat, timeseries
from grafana_foundation_sdk.cog.encoder import JSONEncoder
from grafana_foundation_sdk.models.common import (
    BigValueGraphMode,
    LegendDisplayMode,
    LegendPlacement,
    VisibilityMode,
)
from grafana_foundation_sdk.models.dashboard import (
    DashboardCursorSync,
    DashboardLinkType,
    DataSourceRef,
    VariableRefresh,
)
from panels import DASHBOARDS, Panel

FOLDER = Path(__file__).with_name("dashboards")
SOURCE = DataSourceRef(type_val="prometheus", uid="comvla-prometheus")

# Every query sees the servers of one job, and a window that Grafana fits to the scrape interval.
SELECT = 'job="$job"'
RATE = "$__rate_interval"


def build(name: str) -> str:
    """One dashboard as the JSON that Grafana reads."""
    title, panels = DASHBOARDS[name]
    board = (
        dashboard.Dashboard(title)
        .uid(f"comvla-{name}")
        .tags(["comvla"])
        .refresh("5s")
        .time("now-15m", "now")
        .tooltip(DashboardCursorSync.CROSSHAIR)
        .with_variable(
            dashboard.QueryVariable("job")
            .label("Job")
            .datasource(SOURCE)
            .query("label_values(comvla_server_ready, job)")
            .refresh(VariableRefresh.ON_TIME_RANGE_CHANGED)
        )
        .link(
            dashboard.DashboardLink("Other ComVLA dashboards")
            .type(DashboardLinkType.DASHBOARDS)
            .tags(["comvla"])
            .keep_time(True)
        )
    )
    for panel in panels:
        board = board.with_panel(_stat(panel) if panel.stat else _graph(panel))
    return str(JSONEncoder(sort_keys=True, indent=2).encode(board.build())) + "\n"


def _filled(builder: Any, panel: Panel) -> Any:
    builder = (
        builder.title(panel.title)
        .unit(panel.unit)
        .min(0)
        .datasource(SOURCE)
        .description(panel.text)
    )
    if panel.unit == "dB":
        builder = builder.min(None)
    if panel.maximum is not None:
        builder = builder.max(panel.maximum)
    for letter, (query, legend) in zip("ABCDEF", panel.queries, strict=False):
        expression = query.replace("{S}", SELECT).replace("{R}", RATE)
        target = prometheus.Dataquery().expr(expression).legend_format(legend).ref_id(letter)
        builder = builder.with_target(target)
    return builder


def _stat(panel: Panel) -> Any:
    builder = _filled(stat.Panel(), panel)
    return builder.graph_mode(BigValueGraphMode.AREA).height(5).span(6)


def _graph(panel: Panel) -> Any:
    legend = (
        common.VizLegendOptions()
        .display_mode(LegendDisplayMode.LIST)
        .placement(LegendPlacement.BOTTOM)
        .show_legend(True)
    )
    builder = _filled(timeseries.Panel(), panel)
    return (
        builder.legend(legend)
        .line_width(2)
        .fill_opacity(8)
        .show_points(VisibilityMode.NEVER)
        .height(8)
        .span(12)
    )


def main() -> int:
    """Writes all of them."""
    for name in DASHBOARDS:
        (FOLDER / f"{name}.json").write_text(build(name))
    return 0


if __name__ == "__main__":
    sys.exit(main())
