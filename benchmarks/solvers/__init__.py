"""Contact solvers side by side on the collection: this program's own, and those of other packages.

``forms`` poses a problem as others do. ``pinocchio``, ``quadratic`` and ``numba_engine`` have the
solvers, each a function as ``benchmarks.collection.compare`` describes, with the settings that are
best for it; ``roster`` lists them. ``measure`` runs them, ``groups`` summarises, ``charts`` draws,
and ``run`` is the benchmark.
"""
