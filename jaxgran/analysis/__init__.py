"""Analysis of snapshots: force chains, order, velocity statistics, coarse-grained fields.

It imports `dynamics` and the folders below it, but neither `sampling` nor `io`. Begin with
`series`.
"""
