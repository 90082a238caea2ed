"""From a packing to averages: the steady state, the sample, and its observables.

It imports `dynamics` and the folders below, but neither `analysis` nor `io`. Begin with `sample`,
then `steady_state`.
"""
