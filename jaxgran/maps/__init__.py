"""The grid of restitution, packing fraction, time step and number of grains: batches, workers,
checkpoints, datasets.

It imports `sampling`, `io` and the folders below. Begin with `ratio_map`; `dataset` lists the
contents of a map's file.
"""
