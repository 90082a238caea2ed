"""Parameters and laws from data: restitution, closures of kinetic theory, a friction law.

It imports the datasets of `maps` and what is below. Begin with `restitution`.
"""
