"""The numba engine on CUDA devices: the same law, calendar and bodies of the loops, with the loops
shared out over the lanes of a team.

``loop`` advances a replica, ``contacts`` solves a step; ``lanes`` has the barrier of a team and
what its lanes exchange, ``memory`` the arrays. ``linking`` turns all of it into PTX, and
``handler`` launches that on XLA's stream.
"""
