"""LIBERO: the paper's tasks, simulated in a process and a Python environment of their own.

Nothing here imports LIBERO, robosuite or their MuJoCo; only the child process does. The world is
:class:`comvla_sim.worlds.libero.world.LiberoWorld`, made by ``worlds.make("libero:SUITE")``.
"""
