"""Numbers from snapshots: force chains, order, velocities, coarse-grained fields.

It imports `dynamics` and what is below, but neither `sampling` nor `io`. Begin with `series`.
"""
