"""What the edge adds to the model: vote, select, quantise, pack. Its limit is a matrix product.

At the size of OpenVLA-OFT: 20 text queries, 512 tokens in a language space of 4096, of which 32 with
D = 2176 are coded as INT8, a scale for each of the two vision towers.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import asdict, dataclass
from typing import Any

from comvla_sim.bench import environment

_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_SQUARE_NUMPY, _SQUARE_TORCH = "square product, numpy", "square product, torch"


@dataclass(frozen=True)
class EdgeParameters:
    """Sizes of one edge step.

    Attributes:
        queries: |Q|.
        num_tokens: N.
        language_dim: d, width of the space in which the votes are taken.
        token_budget: K.
        tower_dims: widths of the vision towers; they sum to D.
        quantization: of the transmitted values.
        threads: of the numerical libraries.
        square: side of the square product that measures what the processor can do.
        repetitions: timed runs of each row.
        warm_up: runs before them.
        seed: of the random tokens.
    """

    queries: int = 20
    num_tokens: int = 512
    language_dim: int = 4096
    token_budget: int = 32
    tower_dims: tuple[int, ...] = (1024, 1152)
    quantization: str = "int8"
    threads: int = 1
    square: int = 1024
    repetitions: int = 300
    warm_up: int = 20
    seed: int = 0

    @property
    def vote_flops(self) -> int:
        """Three products of (Q, N, d): attention, task tokens, matching; a multiply-add counts twice."""
        return 3 * 2 * self.queries * self.num_tokens * self.language_dim


def run(parameters: EdgeParameters) -> dict[str, Any]:
    """Measures in a fresh process, because threads are set before a numerical library is loaded.

    Returns:
        An object with ``environment``, ``parameters`` and ``rows``, JSON-able.

    Raises:
        RuntimeError: the process failed; its message is included.
    """
    variables = dict.fromkeys(_THREAD_VARIABLES, str(parameters.threads))
    child = subprocess.run(
        [sys.executable, "-m", "comvla_sim.bench.edge", json.dumps(asdict(parameters))],
        env={**os.environ, **variables},
        capture_output=True,
        text=True,
        check=False,
    )
    if child.returncode != 0:
        raise RuntimeError(f"the measuring process failed: {child.stderr.strip()[-2000:]}")
    result: dict[str, Any] = json.loads(child.stdout)
    return {
        "bench": "edge",
        "environment": environment.describe(),
        "parameters": {**asdict(parameters), "vote_flops": parameters.vote_flops},
        **result,
    }


def measure_rows(parameters: EdgeParameters) -> dict[str, Any]:
    """The rows themselves, in this process with the threads it has."""
    import numpy as np
    import torch

    from comvla import codec
    from comvla_client import scoring, selection
    from comvla_sim.bench.timing import measure

    torch.set_num_threads(parameters.threads)
    random = np.random.default_rng(parameters.seed)

    def draw(*shape: int) -> np.ndarray[Any, np.dtype[np.float32]]:
        return random.standard_normal(shape, np.float32)

    queries = draw(parameters.queries, parameters.language_dim)
    projected = draw(parameters.num_tokens, parameters.language_dim)
    tokens = draw(parameters.num_tokens, sum(parameters.tower_dims))
    square = draw(parameters.square, parameters.square)
    torch_queries, torch_projected, torch_square = map(
        torch.from_numpy, (queries, projected, square)
    )
    k = parameters.token_budget
    importance = scoring.hard_importance(queries, projected)
    chosen = np.asarray(selection.select(importance, k))

    def pack(positions: Any) -> bytes:
        return codec.encode(
            tokens[positions],
            positions,
            parameters.quantization,
            tower_dims=parameters.tower_dims,
        )

    def step(some_queries: Any, some_tokens: Any) -> bytes:
        ranked = selection.select(scoring.hard_importance(some_queries, some_tokens), k)
        return pack(np.asarray(ranked))

    timings = measure(
        {
            _SQUARE_NUMPY: lambda: square @ square,
            _SQUARE_TORCH: lambda: torch_square @ torch_square,
            "three products, numpy": lambda: _three_products(queries, projected),
            "three products, torch": lambda: _three_products(torch_queries, torch_projected),
            "vote, numpy": lambda: scoring.hard_importance(queries, projected),
            "vote, torch": lambda: scoring.hard_importance(torch_queries, torch_projected),
            "select": lambda: selection.select(importance, k),
            "quantise and pack": lambda: pack(chosen),
            "edge step, numpy": lambda: step(queries, projected),
            "edge step, torch": lambda: step(torch_queries, torch_projected),
        },
        repetitions=parameters.repetitions,
        warm_up=parameters.warm_up,
    )
    squares = [timings.pop(name) for name in (_SQUARE_NUMPY, _SQUARE_TORCH)]
    rate = 2 * parameters.square**3 / min(timing.median_s for timing in squares)
    limit_s = parameters.vote_flops / rate
    return {
        "matrix_rate_flops_per_s": rate,
        "vote_limit_s": limit_s,
        "payload_bytes": codec.payload_bytes(k, tokens.shape[1], parameters.quantization),
        "encoded_bytes": len(pack(chosen)),
        "numpy_and_torch_agree": bool(
            (scoring.hard_votes(torch_queries, torch_projected).numpy() == importance.votes).all()
        ),
        "rows": [
            {"name": name, **asdict(timing), "ratio_to_vote_limit": timing.median_s / limit_s}
            for name, timing in timings.items()
        ],
    }


def _three_products(queries: Any, tokens: Any) -> Any:
    """The products of the vote and nothing else: what a perfect softmax and argmax would leave."""
    return ((queries @ tokens.T) @ tokens) @ tokens.T


if __name__ == "__main__":
    given = json.loads(sys.argv[1])
    print(json.dumps(measure_rows(EdgeParameters(**given))))
