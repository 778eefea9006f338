"""Benchmarks that measure their own limit in the same run, so that a figure is a ratio and not a boast."""
