"""Analysis of snapshots: contacts and clusters, coarse-grained fields, fits, and a space of jax-md.

It imports `dynamics` and the folders below it, but not `sampling`. Begin with `series`.
"""
