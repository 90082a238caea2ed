"""Files: trajectories, and files that are written whole or not at all.

It imports `dynamics` and the folders below it, but neither `sampling` nor `analysis`. Begin with `trajectory`.
"""
