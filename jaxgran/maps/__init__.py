"""The grid of restitution, packing fraction and time step: batches, workers, checkpoints, datasets.

It imports `sampling`, `io` and the folders below. Begin with `sweep`; `dataset` lists the contents of a map's file.
"""
