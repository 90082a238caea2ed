"""Files: trajectories (GSD), and arrays with a checksum.

It imports `dynamics` and the folders below it, but neither `sampling` nor `analysis`. Begin with
`trajectory`.
"""
