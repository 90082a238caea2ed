"""What the reference map says of any flow in its range, without a simulation.

It imports `io.paths`, `model` and `theory.assumptions`, and loads neither JAX nor SciPy for
numbers that are known, so that the command line answers in a second. Begin with `validity`.
"""
