"""Closed-loop evaluations: worlds × conditions × methods × K × layouts, with intervals and tests."""
