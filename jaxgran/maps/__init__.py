"""The grid of restitution, packing fraction and time step: batches, workers, checkpoints, datasets.

It imports `sampling`, `io` and what is below. Begin with `sweep`; `dataset` says what a file of a map holds.
"""
