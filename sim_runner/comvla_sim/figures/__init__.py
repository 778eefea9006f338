"""Figures by name: ``comvla-sim figure NAME``."""
