"""The cache of compiled programs on disk: where it is, and that JAX uses it.

It imports `environment` only.
"""
