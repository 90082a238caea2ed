"""Figures from datasets and snapshots. Nothing here starts a simulation.

It imports `inference`, `maps` and what is below. Begin with `ratio`; `drawing` holds what figures share.
"""
