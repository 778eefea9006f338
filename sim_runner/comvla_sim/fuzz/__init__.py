"""Hostile requests by the million: structure-aware mutations against the real server."""
