"""Inference from data: restitution, closures of kinetic theory, a friction law.

It imports the datasets of `maps` and the folders below it. Begin with `restitution`.
"""
