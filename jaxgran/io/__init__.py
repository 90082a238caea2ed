"""Files: trajectories (GSD), and arrays with a checksum.

It imports `analysis` and the folders below it, but not `sampling`. Begin with `trajectory`.
"""
