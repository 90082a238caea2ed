"""What the reference map says of any flow in its range, without a simulation.

It imports `io.paths` and `model`, and loads neither JAX nor SciPy, so that the command line answers
in a second. Begin with `validity`.
"""
