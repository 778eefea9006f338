"""The simulator's side of the pipe. Runs under LIBERO's own Python, so it imports nothing of ours.

Its modules import each other relatively: the parent knows this package as
``comvla_sim.worlds.libero.child``, the child (``__main__.py``) under a name of its own.
"""
