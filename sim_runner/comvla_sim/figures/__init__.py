"""Figures that are measured where they are drawn: what is missing is run first, then plotted."""
