"""Files: trajectories, and files that are written whole or not at all.

It imports `dynamics` and what is below, but neither `sampling` nor `analysis`. Begin with `trajectory`.
"""
