"""Benchmarks and figures: every number and picture of the documentation that is measured.

Run from the root of the repository:

    python -m benchmarks                  # what there is: name, question, minutes, figures
    python -m benchmarks NAME [--quick]   # one of them
    python -m benchmarks NAME --help      # what it measures, and its options

``registry`` names them all. A benchmark is a module with ``run(output, ...)``: it measures, prints,
and writes through ``output`` (see ``output.Output``). ``__main__`` reads the command line and sets
up JAX before anything imports it.
"""
