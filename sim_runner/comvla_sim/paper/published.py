"""What the paper reports, as it reports it: Tables I to IV and the numbers that its text gives of Figs. 4 and 5.

Nothing here was measured by this project. KB in the paper are KiB: 512 · 2176 bytes are its 1088.0.
"""

from __future__ import annotations

from dataclasses import dataclass

PAPER = (
    "B. Liu, W. Y. Poe, J. Di, R. Trivisonno and G. Caire, “ComVLA: Communication-Aware Split Inference for VLA Models "
    "in 6G-Connected Robotics”"
)

SUITES = ("libero_spatial", "libero_object", "libero_goal", "libero_10")
"""LIBERO's suites in the order of the paper's columns."""

SUITE_NAMES = {
    "libero_spatial": "Spatial",
    "libero_object": "Object",
    "libero_goal": "Goal",
    "libero_10": "Long",
}

EPISODES_PER_SUITE = 500
"""50 episodes of 10 tasks."""


@dataclass(frozen=True)
class PaperLine:
    """One line of Table I.

    Attributes:
        label: the paper's name of the method.
        config: the paper's second column.
        kib: TX data per step, KiB.
        tflops: of both sides.
        latency_ms: of both sides, on the paper's H100.
        success: percent by suite, in the order of :data:`SUITES`.
        average: percent, as printed.
    """

    label: str
    config: str
    kib: float
    tflops: float
    latency_ms: float
    success: tuple[float, float, float, float]
    average: float


_LINES = (
    ("full", None, "OpenVLA-OFT", "512 tokens", 1088.0, 8.8, 54.8, (98.4, 97.0, 97.0, 95.2), 96.9),
    ("vla_adp", None, "VLA-ADP", "dynamic", 920.4, 7.7, 52.5, (92.4, 98.4, 96.8, 94.4), 95.5),
    ("lightvla", None, "LightVLA", "dynamic", 165.3, 2.9, 56.9, (98.6, 97.8, 98.0, 94.6), 97.3),
    ("deepjscc", None, "DeepJSCC", "unconstrained", 392.0, 8.8, 55.5, (98.2, 96.6, 97.8, 92.4), 96.3),
    ("witt", None, "WITT", "unconstrained", 192.0, 8.9, 67.6, (97.8, 97.8, 97.8, 93.8), 96.8),
    ("random", 128, "Random Prune", "K=128", 272.0, 2.9, 42.5, (96.8, 96.0, 96.0, 91.6), 95.1),
    ("random", 64, "Random Prune", "K=64", 136.0, 2.7, 42.6, (94.4, 93.0, 96.0, 84.2), 91.9),
    ("random", 48, "Random Prune", "K=48", 102.0, 2.5, 42.6, (87.4, 83.8, 94.2, 74.0), 84.9),
    ("random", 32, "Random Prune", "K=32", 68.0, 2.3, 42.7, (65.8, 32.6, 79.6, 44.8), 55.7),
    ("random", 16, "Random Prune", "K=16", 34.0, 2.1, 42.9, (8.0, 0.0, 22.8, 0.0), 7.7),
    ("hard_voting", 128, "ComVLA", "K=128", 272.0, 2.9, 42.4, (98.2, 96.6, 96.4, 92.2), 95.9),
    ("hard_voting", 64, "ComVLA", "K=64", 136.0, 2.7, 42.6, (97.8, 98.0, 96.8, 93.0), 96.4),
    ("hard_voting", 48, "ComVLA", "K=48", 102.0, 2.5, 42.3, (97.2, 98.2, 97.0, 91.2), 96.0),
    ("hard_voting", 32, "ComVLA", "K=32", 68.0, 2.3, 42.7, (96.2, 97.0, 97.6, 90.8), 95.4),
    ("hard_voting", 16, "ComVLA", "K=16", 34.0, 2.1, 42.7, (37.4, 0.2, 64.4, 35.6), 34.4),
)  # fmt: skip

TABLE1: dict[tuple[str, int | None], PaperLine] = {
    (method, k): PaperLine(label, config, kib, tflops, latency_ms, success, average)
    for method, k, label, config, kib, tflops, latency_ms, success, average in _LINES
}
"""By method and K; None for methods that decide themselves what they send."""

TABLE2 = {
    "OpenVLA-OFT": {"vision": (0.83, 22.6), "vlm": (7.97, 32.2), "total": (8.80, 54.8)},
    "ComVLA": {"vision": (0.83, 22.6), "vlm": (1.46, 20.1), "total": (2.29, 42.7)},
}
"""Operations in TFLOPs and latency in ms, by part; ComVLA at K = 32."""

TABLE3 = {
    "soft_voting": ((97.2, 95.6, 96.6, 84.8), 93.6),
    "hard_voting": ((96.6, 97.2, 97.6, 89.8), 95.3),
}
"""Success at K = 32, percent by suite and average. The hard line equals Table IV's FP16, not Table I's INT8."""

TABLE4 = {
    "float16": (136.0, (96.6, 97.2, 97.6, 89.8), 95.3),
    "int8": (68.0, (96.2, 97.0, 97.6, 90.8), 95.4),
    "int4": (34.0, (69.8, 73.8, 75.8, 49.8), 67.3),
}
"""Hard voting at K = 32: KiB per step, percent by suite, average."""

TABLE_K = 32
"""K of Tables II to IV."""

FIG4_OBJECT_5DB_RICIAN = {"hard_voting": 88.0, "random": 56.2}
"""The only success rates of Fig. 4 that the text gives: Object suite, mean 5 dB, Rician fading, percent."""

FIG5_CLAIM = "yields only a marginal success-rate drop"
"""What the text says of reports that are up to four periods old; it gives no numbers."""
