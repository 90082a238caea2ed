"""The engine for processors: one time loop, compiled by numba and called by XLA.

It imports `contact` and `model`, and the table of the running sums. Begin with `loop`.
"""
