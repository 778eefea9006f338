"""``comvla step``: one observation to a server and back, with the account of what it cost."""

from __future__ import annotations

import argparse
import itertools
import json
import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from comvla.errors import DependencyError, ObservationError
from comvla.model_info import ModelInfo
from comvla.number_arguments import SECONDS, SEED, number, whole
from comvla_client.client import ComVLAClient
from comvla_client.commands.arguments import (
    Subparsers,
    add_link,
    add_target,
    link_of,
    load_edge,
    tls_of,
)
from comvla_client.commands.snr_arguments import add_snr_source, opened
from comvla_client.registry import IMAGE_FORMS, table
from comvla_client.report import ActionChunk
from comvla_client.sending import POLICIES

_DESCRIPTION = """\
Sends one observation and prints the actions and the report of the step.

Without --image the observation is synthetic (noise from --seed): it exercises every part of the
way, but the actions mean nothing.
"""


def add_parser(subparsers: Subparsers) -> argparse.ArgumentParser:
    """Adds ``step`` to the commands."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "step",
        help="send one observation and print the report",
        description=_DESCRIPTION,
        epilog=f"selectors, and picture codings for --uplink:\n{table()}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_target(parser)
    parser.add_argument(
        "--edge",
        default="mini",
        metavar="SOURCE",
        help="robot's half of the model: mini, a folder or hf://owner/name (default: %(default)s)",
    )
    parser.add_argument(
        "--instruction",
        default="push the green drawer shut",
        metavar="WORDS",
        help="what the robot shall do (default: %(default)r)",
    )
    parser.add_argument(
        "--image",
        action="append",
        type=Path,
        metavar="FILE",
        help="picture of one camera; once per view, in the model's order",
    )
    parser.add_argument(
        "--proprio",
        type=number(),
        nargs="+",
        metavar="X",
        help="raw proprioception (default: zeros)",
    )
    parser.add_argument(
        "--selector",
        metavar="NAME",
        default="hard_voting",
        help="who ranks the tokens, a name below or module:ClassName (default: %(default)s)",
    )
    parser.add_argument(
        "--uplink",
        metavar="NAME",
        help="send pictures instead, e.g. jpeg-75: the cloud sees, and the robot needs no model",
    )
    parser.add_argument(
        "--tokens",
        type=whole(1),
        metavar="K",
        help="send K tokens whatever the SNR (bytes of pictures)",
    )
    parser.add_argument(
        "--sending",
        choices=sorted(POLICIES),
        default="paper",
        help="how much is sent when, see docs/edge-sdk.md (default: %(default)s)",
    )
    parser.add_argument(
        "--deadline-s", type=SECONDS, metavar="S", help="longest that a step may take"
    )
    parser.add_argument("--seed", type=SEED, default=0, help="of the synthetic observation")
    parser.add_argument(
        "--repeat",
        type=int,
        default=1,
        metavar="N",
        help="send N times as one robot, 0 without end (default: %(default)s)",
    )
    parser.add_argument(
        "--every-s",
        type=float,
        default=0.4,
        metavar="S",
        help="seconds from one to the next (default: %(default)s, chunks of eight at 20 Hz)",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    add_link(parser)
    add_snr_source(parser)
    return parser


def run(arguments: argparse.Namespace) -> int:
    """Sends the observation. 0 when the cloud answered, 1 when the robot had to fall back.

    Raises:
        ObservationError: a number of times, or a pause, that cannot be.
    """
    if arguments.repeat < 0 or not 0.0 <= arguments.every_s < math.inf:
        raise ObservationError(
            f"expected --repeat and --every-s of at least 0, got {arguments.repeat} and "
            f"{arguments.every_s}: --repeat 0 goes on until Ctrl-C"
        )
    edge = None if _sends_pictures(arguments.uplink) else load_edge(arguments.edge)
    with (
        opened(arguments.snr_source, arguments.snr_db) as snr,
        ComVLAClient(
            arguments.target,
            edge=edge,
            uplink=arguments.uplink,
            link=link_of(arguments),
            quantization=arguments.quantization,
            selector=arguments.selector,
            budget="paper" if arguments.tokens is None else arguments.tokens,
            sending=arguments.sending,
            deadline_s=arguments.deadline_s,
            connect_timeout_s=arguments.connect_timeout_s,
            tls=tls_of(arguments),
            token=arguments.token_file,
            insecure=arguments.insecure,
            seed=arguments.seed,
            snr=snr,
        ) as client,
    ):
        info = client.info
        obs = _observation(arguments, info)
        answered = True
        for _ in _beats(arguments.repeat, arguments.every_s):
            chunk = client.step(obs, arguments.instruction)
            answered &= chunk.source == "cloud"
            if arguments.json:
                line = {"actions": chunk.actions.tolist(), "report": chunk.report.to_dict()}
                print(json.dumps(line), flush=True)
            else:
                print(_text(chunk, info), flush=True)
    return 0 if answered else 1


def _beats(times: int, every_s: float) -> Iterator[int]:
    """Counts, in a steady rhythm; a beat that was missed is not made up for."""
    due_s = time.monotonic()
    for beat in itertools.count() if times == 0 else range(times):
        yield beat
        due_s = max(due_s + every_s, time.monotonic())
        if beat + 1 != times:
            time.sleep(max(0.0, due_s - time.monotonic()))


def _sends_pictures(uplink: str | None) -> bool:
    return uplink is not None and uplink.partition("-")[0] in IMAGE_FORMS


def _observation(arguments: argparse.Namespace, info: ModelInfo) -> dict[str, Any]:
    if arguments.image:
        images = [_read_image(path, info.image_size) for path in arguments.image]
    else:
        rng = np.random.default_rng(arguments.seed)
        shape = (*info.image_size, 3)
        images = [rng.integers(0, 256, shape, dtype=np.uint8) for _ in range(info.grid[0])]
    return {"images": images, "proprio": arguments.proprio or [0.0] * info.proprio_dim}


def _read_image(path: Path, size: tuple[int, int]) -> npt.NDArray[np.uint8]:
    try:
        from PIL import Image
    except ImportError as error:
        raise DependencyError("reading pictures needs Pillow: pip install pillow") from error
    try:
        with Image.open(path) as picture:
            height, width = size
            return np.asarray(picture.convert("RGB").resize((width, height)))
    except OSError as error:
        raise ObservationError(
            f"expected a picture in {path}, got: {error}; pass a PNG or JPEG file"
        ) from error


def _text(chunk: ActionChunk, info: ModelInfo) -> str:
    report = chunk.report
    milliseconds = {name: f"{1e3 * s:.1f}" for name, s in report.timings_s.items() if s}
    server = {name: f"{1e3 * s:.1f}" for name, s in report.server_timings_s.items()}
    answered = (
        "from the cloud" if report.source == "cloud" else f"no answer: {report.fallback_reason}"
    )
    # Pictures have bytes where tokens have K.
    pictures = report.source == "cloud" and report.tokens == 0
    budget = f", K* {report.paper_budget}, framed {report.framed_budget}"
    lines = [
        f"model     {info.name} (N {info.num_tokens}, D {info.token_dim})",
        f"source    {report.source} ({answered}{'; ' + report.detail if report.detail else ''})",
        f"link      {report.snr_db} dB, {report.capacity_bits or 0:.0f} bits a period"
        f"{'' if report.paper_budget is None else budget}",
        f"policy    {report.policy}: up to {report.token_budget} {'bytes' if pictures else 'tokens'} in "
        f"{1e3 * report.window_s:.0f} ms, {report.tokens_used} tokens {'made of them' if pictures else 'arrived'}",
        f"sent      {report.uplink}: {'pictures' if pictures else f'{report.tokens} tokens'}, "
        f"{report.payload_bytes} B by the paper's accounting, {report.encoded_bytes} B coded, "
        f"{report.framed_bytes} B framed",
        f"robot ms  {' '.join(f'{k} {v}' for k, v in milliseconds.items())}",
        f"server ms {' '.join(f'{k} {v}' for k, v in server.items()) or '-'}",
        f"flops     edge {report.edge_flops:.3g}, cloud {report.cloud_flops:.3g}",
        "actions",
    ]
    rows = [" ".join(f"{value:9.4f}" for value in row) for row in chunk.actions]
    return "\n".join([*lines, *(f"  {row}" for row in rows)])
