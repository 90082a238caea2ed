"""Benchmarks and figures: every number and picture of the documentation that is measured.

A benchmark is a module here with ``run(output, …)``: it measures, prints, and writes through
``output`` (see ``output.Output``). Its docstring says what it asks, at which N and dt, and how long
it takes. Further arguments of ``run`` are options of its command. ``ONE_CORE = True`` holds JAX to
one core.
"""

from pathlib import Path

ROOT = Path(__file__).parents[1]
