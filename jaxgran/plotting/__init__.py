"""Figures from datasets and snapshots. Nothing here starts a simulation.

It imports `maps` and the folders below them. Begin with `ratio`; `style`, `selection` and `plane`
hold what figures share.
"""
