"""The guide's example runs as printed, with a small checkpoint in the place of the published one."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from published_folder import HEADER
from reference_data import needs_golden

from comvla_server.background import BackgroundServer
from comvla_server.engine import Engine
from comvla_vla import Recipe
from comvla_vla.checkpoints.accounting import half_size
from comvla_vla.checkpoints.published import published_config

GUIDE = Path(__file__).parents[2] / "docs" / "openvla-oft.md"


@needs_golden
def test_the_example_runs(reference, capsys):
    _, _, cloud = reference("oft")
    (code,) = re.findall(r"```py\n(.*?)```", GUIDE.read_text(), re.DOTALL)
    with BackgroundServer(Engine(cloud)) as server:
        folder = reference("oft").published.parent / "split"
        code = code.replace("oft-spatial", str(folder)).replace("127.0.0.1:50051", server.target)
        exec(compile(code, str(GUIDE), "exec"), {})
    assert capsys.readouterr().out.startswith("(8, 7) cloud ")


def test_the_sizes_are_those_of_the_full_size_model():
    header = {k: v for k, v in HEADER.items() if k != "x_vit_overrides"}
    header |= {"text_config": {"model_type": "llama"}, "image_sizes": [224, 224]}
    config = published_config(header, {}, Recipe())
    for half in ("edge", "cloud"):
        count = half_size(half, config).parameters
        row = next(r for r in GUIDE.read_text().splitlines() if r.startswith(f"| `{half}/`"))
        said = [float(n) for n in re.findall(r"([\d.]+) G", row)]
        assert said == pytest.approx([count / 1e9, 2 * count / 1e9, 4 * count / 1e9], abs=0.06)
