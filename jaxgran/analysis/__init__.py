"""Numbers from snapshots: force chains, order, velocities, coarse-grained fields.

It imports `dynamics` and the folders below it, but neither `sampling` nor `io`. Begin with `series`.
"""
