"""Choices of a user, limits of numbers, and the width of intervals: constants that need no other
module.
"""

from typing import Literal

Activation = Literal["midpoint", "touching"]
EngineName = Literal["auto", "numba", "jax"]  # on the command line and in files
FileFormat = Literal["png", "pdf", "svg"]  # of a figure
SolverName = Literal["nesterov", "barzilai-borwein", "jacobi"]

MAX_PACKING_FRACTION = 0.83
MIN_GRAINS = 16
MAX_GRAINS = 10**7  # more need over 20 GB of memory
MAX_REPLICAS = 10**6  # of one map
MAX_STEPS = 2**31 - 1  # of one sample: an int32 counts the steps
HALF_INTERVAL = 1.96  # standard errors in half an interval of 95 %
SHORTEST_TIMESTEP = 1e-8  # 1/γ̇; the longest block of a run then has fewer than MAX_STEPS steps
