"""Analysis of snapshots: force chains, coarse-grained fields, fits, and a space of jax-md.

It imports `dynamics` and the folders below it, but neither `sampling` nor `io`. Begin with
`series`.
"""
