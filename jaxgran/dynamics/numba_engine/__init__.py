"""The engine of one time loop for each replica, compiled by numba and called by XLA.

It imports `contact` and `model`, and the table of the running sums. Begin with `loop`; `team` is
the same for CUDA devices.
"""
