"""A collection of contact problems as data: made from seeds, solved in extended precision, kept in
one file.

``problems`` makes them, ``certificates`` solves them and proves it, ``files`` writes and reads the
file, and ``make`` is the benchmark that does all of this. Whoever compares solvers needs ``load``
alone.
"""

from benchmarks.collection.files import PATH, Entry, load

__all__ = ["PATH", "Entry", "load"]
