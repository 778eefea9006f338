"""Learned image codecs in the simulation: training, curves, and their place in an evaluation."""
